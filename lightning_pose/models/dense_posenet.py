"""DensePoseNet: three fully connected layers over a frozen CNN's features (thesis, chapter 5)."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lightning_pose.data.datamodule import scene_datamodule
from lightning_pose.errors import ConfigError
from lightning_pose.models.base import PoseModule
from lightning_pose.models.parts.ridge import Moments

__all__ = ["DensePoseNet"]


class DensePoseNet(PoseModule):
    """Fully connected layers, each with ReLU, from (D,) features or their principal components to the pose.

    The thesis trains it with eq. 5.3: `loss: {form: split, orientation_weight: 10, normalize_quat: true}` indoors, 100
    outdoors. The table of the thesis counts 573,824 parameters for 2048 features; its layers have 566,151.

    Args:
        units: width of each layer.
        dropout: after each layer.
        components: read so many principal components of the training features (eq. 5.4) instead of all features; the
            checkpoint carries them in half precision, so that with few components it is smaller than without.
        **kwargs: what `PoseModule` takes.

    Raises:
        ConfigError: `units` or `components` is not positive; in `fit`, more components than the training features have.
    """

    input_ranks: ClassVar[tuple[int, ...]] = (1,)
    network: nn.Sequential

    def __init__(
        self,
        units: list[int] = [256, 128, 64],  # noqa: B006  (never changed; shown as it is in --help)
        dropout: float = 0.0,
        components: int | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        if not units or min(units) < 1:
            raise ConfigError(f"units is {units}; give the width of one layer or more, such as [256, 128, 64]")
        if components is not None and components < 1:
            raise ConfigError(f"components is {components}; give 1 or more, or null for all features")
        self.components = components
        n_features = self.input_shape[0]
        layers: list[nn.Module] = [] if components is None else [_Projection(n_features, components)]
        for wide, narrow in pairwise([components or n_features, *units]):
            layers += [nn.Linear(wide, narrow), nn.ReLU(), nn.Dropout(dropout)]
        self.network = nn.Sequential(*layers, nn.Linear(units[-1], 7))

    @property
    def headline(self) -> str:
        return f"D={self.input_shape[0]}" + (f" components={self.components}" if self.components else "")

    @property
    def reduced_shape(self) -> tuple[int, ...]:
        return (self.components,) if self.components else self.input_shape

    def setup(self, stage: str) -> None:
        super().setup(stage)
        first = self.network[0]
        if stage == "fit" and isinstance(first, _Projection):
            features = scene_datamodule(self.trainer).dataset("train").data.features
            first.fit(self.standardize_input(features.to(self.device)))


class _Projection(nn.Module):
    """Principal components in half precision, scaled so that they vary by 1 on average.

    Rounding moves a component by less than a thousandth of its spread, and training reads the rounded ones too.
    """

    mean: Tensor
    components: Tensor

    def __init__(self, n_features: int, components: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(n_features))
        self.register_buffer("components", torch.eye(components, n_features, dtype=torch.float16))

    def fit(self, features: Tensor) -> None:
        """Learn from (N, D) training features."""
        moments = Moments(features.shape[1])
        for chunk in features.split(1024):
            moments.add(chunk, chunk[:, :0])
        values, vectors, mean = moments.spectrum().first(len(self.components))
        scale = (values.mean() / moments.count).sqrt()
        self.mean.copy_(mean)
        self.components.copy_(vectors.T / scale)

    def forward(self, features: Tensor) -> Tensor:
        """(B, D) -> (B, K)."""
        return F.linear(features - self.mean, self.components.to(features.dtype))
