"""CNN3D: convolutions over space and time at once (thesis, chapter 6)."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn
from torch.nn import functional as F

from lightning_pose.errors import ConfigError
from lightning_pose.models.clip import ClipModule

__all__ = ["CNN3D"]


class CNN3D(ClipModule):
    """Two convolutions of 3x3x3, each with ReLU and average pooling of 1x5x5, then two linear layers a frame.

    Fig. 6.2 of the thesis, which trains it with eq. 6.3: `loss: {form: split, norm: squared, orientation_weight: 250}`.
    A frame's pose depends on the two frames before it and the two after it, for every T. So the network must infer
    the frame's place in the clip from these alone, unless it integrates. Pools are in ceil mode, so that one
    descriptor is enough.

    Args:
        channels: filters of both convolutions.
        units: width of the linear layer.
        causal: let a frame's pose depend on earlier frames only, up to four of them, for a live camera.
        dropout: before the last linear layer.
        **kwargs: what `ClipModule` takes.

    Raises:
        ConfigError: a width is not positive, or dropout out of 0..1.
    """

    def __init__(
        self, channels: int = 64, units: int = 1000, causal: bool = False, dropout: float = 0.0, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        if channels < 1 or units < 1 or not 0 <= dropout < 1:
            raise ConfigError(f"channels {channels}, units {units}, dropout {dropout}: give 1 or more, 0 to below 1")
        self.network = _Conv3d(self.image_shape, channels, units, causal, dropout)


class _Conv3d(nn.Module):
    """Convolutions over space and time with their pools, and two linear layers for each frame."""

    def __init__(self, shape: tuple[int, int, int], channels: int, units: int, causal: bool, dropout: float) -> None:
        super().__init__()
        depth, height, width = shape
        self.before, self.after = (2, 0) if causal else (1, 1)
        self.stages = nn.ModuleList(
            nn.Sequential(nn.Conv3d(wide, channels, 3, padding=(0, 1, 1)), nn.ReLU(), _FramePool())
            for wide in (depth, channels)
        )
        flat = channels * -(-height // 25) * -(-width // 25)
        self.head = nn.Sequential(nn.Linear(flat, units), nn.ReLU(), nn.Dropout(dropout), nn.Linear(units, 7))

    def forward(self, clips: Tensor) -> Tensor:
        """(B, T, C, H, W) -> (B, T, 7)."""
        blocks = clips.transpose(1, 2)
        for stage in self.stages:
            blocks = stage(F.pad(blocks, (0, 0, 0, 0, self.before, self.after)))
        return self.head(blocks.transpose(1, 2).flatten(2))


class _FramePool(nn.Module):
    """Average pooling of 1x5x5 in ceil mode; AvgPool3d itself refuses what is smaller than 5."""

    def forward(self, blocks: Tensor) -> Tensor:
        """(B, C, T, H, W) -> (B, C, T, H / 5, W / 5)."""
        return F.avg_pool2d(blocks.flatten(1, 2), 5, ceil_mode=True).unflatten(1, blocks.shape[1:3])
