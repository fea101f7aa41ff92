"""DivergenceWatch: whether training has diverged, which no later epoch mends."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from lightning_pose.errors import ConfigError

__all__ = ["DivergenceWatch"]

FACTOR = 1000.0
FLOOR_M = 1e-3  # where all training positions are one


class DivergenceWatch:
    """Collects losses and errors of training steps on their device, and compares them once an epoch.

    Training has diverged where a loss, an error or a weight is not finite, or where the mean position error is over
    1000 times what it was at the first step plus the spread of the training positions.

    Attributes:
        spread_m: mean distance of the training positions from their mean.
    """

    def __init__(self) -> None:
        self.spread_m = 0.0
        self._first: Tensor | None = None
        self._sums: Tensor | None = None
        self._steps = 0

    def add_step(self, loss: Tensor, position_hat: Tensor, position_m: Tensor) -> None:
        """Add the loss and the positions (..., 3) of one training step."""
        error = (position_hat.detach() - position_m).norm(dim=-1).mean()
        if self._first is None:
            self._first = error
        step = torch.stack([loss.detach().to(error.dtype), error])
        self._sums = step if self._sums is None else self._sums + step
        self._steps += 1

    def check_epoch(self, remedy: str) -> None:
        """Compare the steps since the last check, and forget them.

        Args:
            remedy: what the user can do, the end of the error's message.

        Raises:
            ConfigError: training has diverged.
        """
        if self._sums is None:
            return
        loss, error = (self._sums / self._steps).tolist()
        self._sums, self._steps = None, 0
        if not math.isfinite(loss):
            raise ConfigError(f"training has diverged: the loss is {loss}; {remedy}")
        self.check_error(error, remedy)

    def check_error(self, error_m: float, remedy: str) -> None:
        """Compare a mean or median position error in metres with that of the first step.

        Raises:
            ConfigError: training has diverged.
        """
        if self._first is None:
            return
        most = FACTOR * (float(self._first) + self.spread_m) + FLOOR_M
        if not error_m <= most:
            raise ConfigError(
                f"training has diverged: positions are off by {error_m:.3g} m, and training positions lie "
                f"{self.spread_m:.3g} m around their mean; {remedy}"
            )

    def check_weights(self, weights: Iterable[Tensor], remedy: str) -> None:
        """Raise ConfigError if some weights are not finite."""
        if not all(bool(weight.isfinite().all()) for weight in weights):
            raise ConfigError(f"training has diverged: the model's weights are not finite numbers; {remedy}")
