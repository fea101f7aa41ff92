"""A CNN so small that torch traces it in no time."""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["BACKBONE", "COLUMNS", "Shrink"]

COLUMNS = 12

BACKBONE = "tests.export.helpers.Shrink"


class Shrink(nn.Module):
    """One convolution: (B, 3, H, W) to a map (B, COLUMNS, H / 16, W / 16)."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Conv2d(3, COLUMNS, 16, stride=16)
        values = torch.linspace(-1, 1, self.layer.weight.numel()).sin()
        self.layer.weight.data = values.view_as(self.layer.weight) * 0.1
        self.layer.bias = None

    def forward(self, rgb: Tensor) -> Tensor:
        return self.layer(rgb).relu()
