"""LinearPoseNet: one ridge regression from a frozen CNN's features, solved in closed form (thesis, chapter 5)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lightning_pose.models.closed_form import ClosedFormModule, LinearNetwork
from lightning_pose.models.parts.ridge import Ridge

__all__ = ["LinearPoseNet"]


class LinearPoseNet(ClosedFormModule):
    """Ridge regression (eq. 5.2) from (D,) features to the pose, without gradients.

    One pass over the training batches sums their moments; memory is of the order of D x D for any number of frames.
    Further passes make the weights exact (`solve_ridges`). The lambda with the lowest loss on validation frames is
    kept.

    Args:
        lambdas: ridge strengths to choose from, in squared units of the features, summed over frames.
        **kwargs: what `ClosedFormModule` takes.

    Raises:
        ConfigError: as for `ClosedFormModule`.
    """

    network: _FoldedLinear

    def __init__(
        self,
        lambdas: list[float] = [8.0],  # noqa: B006  (never changed; shown as it is in --help)
        **kwargs: Any,
    ) -> None:
        super().__init__(lambdas=lambdas, **kwargs)
        self.network = _FoldedLinear(self.input_shape[0], self.components)

    @property
    def headline(self) -> str:
        return f"D={self.input_shape[0]}" + (f" components={self.components}" if self.components else "")

    @property
    def reduced_shape(self) -> tuple[int, ...]:
        return (self.components,) if self.components else self.input_shape


class _FoldedLinear(LinearNetwork):
    """Seven numbers, linear in the features.

    With principal components, 7 x K coefficients are learnt, and their product with the components, 7 x D, is
    applied. Keeping the K x D components instead would add megabytes to the file and no information.
    """

    bias: Tensor
    folded: Tensor | None

    def __init__(self, n_features: int, components: int | None) -> None:
        super().__init__()
        self.n_features = n_features
        self.weight = nn.Parameter(torch.zeros(7, components or n_features))
        self.register_buffer("bias", torch.zeros(7))
        self.register_buffer("folded", torch.zeros(7, n_features) if components else None)

    @property
    def n_lifted(self) -> int:
        return self.n_features

    def lift(self, features: Tensor) -> Tensor:
        return features

    def set_solution(self, solution: Ridge) -> None:
        self.weight.copy_(solution.coefficients)
        self.bias.copy_(solution.bias)
        if self.folded is not None:
            self.folded.copy_(solution.weight)

    def forward(self, features: Tensor) -> Tensor:
        return F.linear(features, self.weight if self.folded is None else self.folded, self.bias)
