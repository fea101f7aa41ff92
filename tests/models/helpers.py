"""A problem that any architecture can learn: features that are a fixed linear image of the pose."""

from __future__ import annotations

import math

import torch
from lightning import LightningDataModule
from torch import nn
from torch.utils.data import DataLoader

from lightning_pose import models
from lightning_pose.data.batches import PoseBatch, PoseDataset, batch_loader
from lightning_pose.models import PoseModule

__all__ = ["ARCHITECTURES", "LearnableProblem", "SmallCNN", "make_model", "random_poses"]

_INPUT_SHAPES = {1: [32], 2: [20, 64], 3: [16, 3, 4]}

_exported = [getattr(models, name) for name in models.__all__]
ARCHITECTURES = [
    cls for cls in _exported if isinstance(cls, type) and issubclass(cls, PoseModule) and cls is not PoseModule
]


def make_model(architecture: type[PoseModule], **settings: object) -> PoseModule:
    """An architecture with its default settings, for a small input, the same weights each time."""
    torch.manual_seed(0)
    if architecture is models.PoseNet:
        small = {"backbone": "tests.models.helpers.SmallCNN", "crop": 12, "input_shape": [3, 12, 12]}
    else:
        small = {"input_shape": _INPUT_SHAPES[architecture.input_rank]}
    model = architecture(**{**small, **settings})  # type: ignore[arg-type]
    if isinstance(model, models.NodePose):
        model.remember(LearnableProblem(list(model.input_shape)).data.data)
    return model


class SmallCNN(nn.Module):
    """A backbone for small crops, frozen as users' modules may be."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.layers = nn.Sequential(nn.Conv2d(3, 32, 4, 4), nn.BatchNorm2d(32), nn.ReLU(), nn.Conv2d(32, 64, 3))
        self.eval().requires_grad_(False)

    def forward(self, rgb: torch.Tensor) -> torch.Tensor:
        return self.layers(rgb * 255)


def random_poses(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """(count, 3) positions around (5, 0, -2) m, and (count, 4) rotations of up to 60 degrees, w > 0."""
    generator = torch.Generator().manual_seed(seed)
    position_m = torch.randn(count, 3, generator=generator) + torch.tensor([5.0, 0.0, -2.0])
    axis = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    half_angle = torch.rand(count, 1, generator=generator) * math.pi / 6
    return position_m, torch.cat([half_angle.cos(), half_angle.sin() * axis], dim=-1)


class LearnableProblem(LightningDataModule):
    """Frames whose features are the pose times a fixed random matrix, so that there is all to learn and no noise."""

    def __init__(self, input_shape: list[int], count: int = 24) -> None:
        super().__init__()
        position_m, quat_wxyz = random_poses(count)
        pose = torch.cat([position_m, quat_wxyz], dim=-1)
        pose = (pose - pose.mean(0)) / pose.std(0)
        mix = torch.randn(7, math.prod(input_shape), generator=torch.Generator().manual_seed(1)) / 7**0.5
        features = (pose @ mix).reshape(count, *input_shape)
        self.data = PoseDataset(PoseBatch(features, position_m, quat_wxyz, torch.arange(count)))

    def dataset(self, split: str) -> PoseDataset:
        return self.data

    def train_dataloader(self) -> DataLoader[PoseBatch]:
        return batch_loader(self.data, batch_size=8, shuffle=True)
