"""CNNRNN: the same convolutions over each frame of a clip, then a recurrent network over time (thesis, chapter 6)."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from lightning_pose.errors import ConfigError
from lightning_pose.models.clip import ClipModule

__all__ = ["CNNRNN"]


class CNNRNN(ClipModule):
    """Two convolutions a frame, 7x7 and 3x3, each with ReLU, batch normalisation and average pooling, then an LSTM.

    Fig. 6.1 of the thesis, which trains it with eq. 6.2: `loss: {form: split, norm: squared, orientation_weight: 250,
    trajectory_weight: 1}`. Pools are in ceil mode, so that as few as one descriptor will do.

    Args:
        channels: filters of both convolutions.
        units: of the LSTM, in each direction.
        bidirectional: let a frame's pose depend on later frames too; off, it is causal, for a live camera.
        dropout: before the last linear layer.
        **kwargs: what `ClipModule` takes.

    Raises:
        ConfigError: a width is not positive, or dropout out of 0..1.
    """

    def __init__(
        self, channels: int = 64, units: int = 100, bidirectional: bool = True, dropout: float = 0.0, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        if channels < 1 or units < 1 or not 0 <= dropout < 1:
            raise ConfigError(f"channels {channels}, units {units}, dropout {dropout}: give 1 or more, 0 to below 1")
        self.network = _ConvLSTM(self.image_shape, channels, units, bidirectional, dropout)


class _ConvLSTM(nn.Module):
    """Convolutions over each frame, an LSTM over time, and a linear layer for each frame."""

    def __init__(
        self, shape: tuple[int, int, int], channels: int, units: int, bidirectional: bool, dropout: float
    ) -> None:
        super().__init__()
        depth, height, width = shape
        self.convolutions = nn.Sequential(
            nn.Conv2d(depth, channels, 7, padding=3),
            nn.ReLU(),
            nn.BatchNorm2d(channels),
            nn.AvgPool2d(2, ceil_mode=True),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.ReLU(),
            nn.BatchNorm2d(channels),
            nn.AvgPool2d(2, ceil_mode=True),
        )
        flat = channels * -(-height // 4) * -(-width // 4)
        self.lstm = nn.LSTM(flat, units, batch_first=True, bidirectional=bidirectional)
        self.head = nn.Sequential(nn.Dropout(dropout), nn.Linear(units * (1 + bidirectional), 7))

    def forward(self, clips: Tensor) -> Tensor:
        """(B, T, C, H, W) -> (B, T, 7)."""
        frames = self.convolutions(clips.flatten(0, 1)).flatten(1)
        states, _ = self.lstm(frames.unflatten(0, clips.shape[:2]))
        return self.head(states)
