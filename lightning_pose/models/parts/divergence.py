"""DivergenceWatch: whether training has diverged, which no later epoch mends."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from lightning_pose.errors import ConfigError

__all__ = ["DivergenceWatch"]

FACTOR = 1000.0

WORSE = 3.0
"""Positions off by this many times the training positions' spread are worse than any constant answer."""


MOST_STEPS = 1000
"""Steps that are looked at together, so that an epoch of hours does not go on after its loss is no number."""


class DivergenceWatch:
    """Collects losses and errors of training steps on their device, and compares them once an epoch.

    Training has diverged where a loss, an error or a weight is not finite, or where the mean position error is over
    1000 times what it was at the first step plus the spread of the training positions. It has grown apart where the
    last epoch's loss and errors are finite, and worse than the first epoch's and than a constant answer's.

    Positions are local, as networks see them.

    Attributes:
        spread_m: mean distance of the training positions from their mean; 0 for one position, which sets no bound.

    Args:
        name_frame: a frame's index in the scene to its name, for messages.
    """

    def __init__(self, name_frame: Callable[[int], str] = str) -> None:
        self.spread_m = 0.0
        self._name_frame = name_frame
        self._first: Tensor | None = None
        self._steps: list[Tensor] = []  # loss and position error
        self._frames: list[Tensor] = []
        self._done: list[tuple[float, float]] = []  # of the epoch's steps that have been looked at
        self._epochs: list[tuple[float, float]] = []  # loss and position error of the first and the last epoch

    def add_step(self, loss: Tensor, position_hat: Tensor, position_m: Tensor, frame: Tensor, remedy: str) -> None:
        """Add one training step.

        Args:
            loss: of the step.
            position_hat: (..., 3), of the network.
            position_m: (..., 3), of the batch.
            frame: of the batch, indices of frames in the scene.
            remedy: as for `check_epoch`.

        Raises:
            ConfigError: training has diverged; it is looked at every 1000 steps.
        """
        error = (position_hat.detach() - position_m).norm(dim=-1).mean()
        if self._first is None:
            self._first = error
        self._steps.append(torch.stack([loss.detach().to(error.dtype), error]))
        self._frames.append(frame)
        if len(self._steps) == MOST_STEPS:
            self._check_steps(remedy)

    def check_epoch(self, remedy: str) -> None:
        """Compare the steps since the last check, and forget them.

        Args:
            remedy: what the user can do, the end of the error's message.

        Raises:
            ConfigError: training has diverged.
        """
        self._check_steps(remedy)
        if not self._done:
            return
        loss, error = (sum(values) / len(values) for values in zip(*self._done, strict=True))
        self._done = []
        self.check_error(error, remedy)
        self._epochs = [*self._epochs[:1], (loss, error)]

    def _check_steps(self, remedy: str) -> None:
        """Look at the losses of the steps since the last time.

        Raises:
            ConfigError: one is no finite number.
        """
        if not self._steps:
            return
        values, frames = torch.stack(self._steps).tolist(), self._frames
        self._steps, self._frames = [], []
        bad = next((i for i, (loss, _) in enumerate(values) if not math.isfinite(loss)), None)
        if bad is not None:
            batch, shown = frames[bad].flatten().unique().tolist(), 3
            named = ", ".join(self._name_frame(int(i)) for i in batch[:shown]) + (", ..." if len(batch) > shown else "")
            number = len(self._done) + bad + 1
            raise ConfigError(
                f"training has diverged: the loss is {values[bad][0]} in batch {number} of the epoch (frames {named}); "
                f"{remedy}"
            )
        self._done += [(loss, error) for loss, error in values]

    def describe_growth(self) -> str | None:
        """What is wrong with a training that has ended farther off than it began; None if nothing is."""
        if len(self._epochs) < 2:
            return None
        (first_loss, first_error), (loss, error) = self._epochs
        if not (loss > first_loss and error > first_error and error > WORSE * self.spread_m > 0):
            return None
        return (
            f"the loss grew from {first_loss:.3g} in the first epoch to {loss:.3g} in the last, and training positions "
            f"are off by {error:.3g}, {error / self.spread_m:.1f} times their spread"
        )

    def check_error(self, error_m: float, remedy: str) -> None:
        """Compare a mean or median error of local positions with that of the first step.

        Raises:
            ConfigError: training has diverged.
        """
        if self._first is None:
            return
        most = FACTOR * (float(self._first) + (self.spread_m or 1.0))
        if not error_m <= most:
            raise ConfigError(
                f"training has diverged: positions are off by {error_m:.3g} m, and training positions lie "
                f"{self.spread_m:.3g} m around their mean; {remedy}"
            )

    def check_weights(self, weights: Iterable[Tensor], remedy: str) -> None:
        """Raise ConfigError if some weights are not finite."""
        if not all(bool(weight.isfinite().all()) for weight in weights):
            raise ConfigError(f"training has diverged: the model's weights are not finite numbers; {remedy}")
