"""SurfCNN: a small convolutional network over the image that stacked descriptors make (thesis, chapter 2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from lightning_pose.errors import ConfigError
from lightning_pose.models.base import PoseModule

__all__ = ["SurfCNN"]


class SurfCNN(PoseModule):
    """Convolutions over (N, D) descriptors, strongest first, as an image of one channel (thesis, table 2.1).

    Each convolution is followed by ReLU, batch normalisation and a pool. The descriptor's 64 elements can be halved
    that often; the N features cannot, or table 2.2's parameter counts are not met. So the first three pools are 2x2
    and the last two 1x2, along the descriptor, in ceil mode.

    The order by strength changes from frame to frame. With `ordered` off, kernels, strides and pools extend along
    each descriptor only, and the maps are averaged over the features, so that their order does not matter. Rows that
    fill up a frame with fewer features do not count.

    Args:
        channels: filters of each convolution.
        kernels: side of each convolution's kernel; the first has stride 2.
        layers: how many convolutions, the last of the two lists repeated beyond their end (fig. 2.4); as many as they
            have, if not given.
        units: width of the fully connected layer.
        dropout: before the last linear layer.
        ordered: whether the result depends on the order of the features; it does in the thesis.
        **kwargs: what `PoseModule` takes.

    Raises:
        ConfigError: `channels` and `kernels` differ in length, a kernel is even, or `layers` is not positive.
    """

    input_ranks: ClassVar[tuple[int, ...]] = (2,)

    def __init__(
        self,
        channels: list[int] = [64, 128, 256, 256, 256],  # noqa: B006  (never changed; shown as it is in --help)
        kernels: list[int] = [7, 5, 5, 5, 3],  # noqa: B006
        layers: int | None = None,
        units: int = 2048,
        dropout: float = 0.5,
        ordered: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        if len(channels) != len(kernels) or not channels or any(kernel % 2 == 0 for kernel in kernels):
            raise ConfigError(
                f"channels {channels} and kernels {kernels} do not fit: give as many of each, kernels odd"
            )
        if layers is not None and layers < 1:
            raise ConfigError(f"layers is {layers}; give 1 or more")
        depth = len(channels) if layers is None else layers
        channels, kernels = (sizes[:depth] + sizes[-1:] * (depth - len(sizes)) for sizes in (channels, kernels))
        self.ordered = ordered
        self.network = _ConvRegressor(self.input_shape, channels, kernels, units, dropout, ordered)

    @property
    def headline(self) -> str:
        return f"N={self.input_shape[0]}" + ("" if self.ordered else " unordered")


class _ConvRegressor(nn.Module):
    """The convolutions with their pools, and two linear layers."""

    def __init__(
        self,
        input_shape: tuple[int, ...],
        channels: Sequence[int],
        kernels: Sequence[int],
        units: int,
        dropout: float,
        ordered: bool,
    ) -> None:
        super().__init__()
        self.ordered = ordered
        stages: list[nn.Module] = []
        rows, columns = input_shape
        width = 1
        for i, (out, kernel) in enumerate(zip(channels, kernels, strict=True)):
            stride = 2 if i == 0 else 1
            over_rows = (kernel, stride, 2 if i < 3 else 1) if ordered else (1, 1, 1)
            kernels_2d, strides, pools = zip(over_rows, (kernel, stride, 2), strict=True)
            stages += [
                nn.Conv2d(width, out, kernels_2d, strides, padding=(kernels_2d[0] // 2, kernel // 2)),
                nn.ReLU(),
                nn.BatchNorm2d(out),
                nn.MaxPool2d(pools, ceil_mode=True),
            ]
            rows, columns = (-(-size // (s * p)) for size, s, p in zip((rows, columns), strides, pools, strict=True))
            width = out
        # Channels last, where convolutions along single rows are three times as fast on a CPU.
        self.convolutions = nn.Sequential(*stages).to(memory_format=torch.channels_last)
        self.head = nn.Sequential(
            nn.Flatten(),
            nn.Linear(width * columns * (rows if ordered else 1), units),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(units, 7),
        )

    def forward(self, descriptors: Tensor) -> Tensor:
        """(B, N, D) -> (B, 7)."""
        maps = self.convolutions(descriptors.unsqueeze(1))  # (B, channels, rows, columns)
        return self.head(maps if self.ordered else _average_real_rows(maps, descriptors.any(-1)))


def _average_real_rows(maps: Tensor, real: Tensor) -> Tensor:
    """(B, channels, columns): means of (B, channels, N, columns) over the N features that are `real` (B, N).

    Of all, where none is: the mean of a blank frame is finite.
    """
    if real.all():
        return maps.mean(dim=2)
    real = real | ~real.any(1, keepdim=True)
    weight = real.to(maps.dtype)[:, None, :, None]
    return (maps * weight).sum(dim=2) / weight.sum(dim=2)
