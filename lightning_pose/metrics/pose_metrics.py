"""Pose errors of a split, collected batch by batch and over processes, and their summary."""

from __future__ import annotations

import torch
from torch import Tensor
from torchmetrics import Metric

from lightning_pose.geometry.quaternions import orientation_error_deg, position_error_m
from lightning_pose.metrics.item_means import select_unique
from lightning_pose.metrics.summary import summarize_errors

__all__ = ["PoseMetrics"]


class PoseMetrics(Metric):
    """Median, mean and 95th percentile errors and recalls over all frames added (see `summarize_errors`).

    Keeps every frame's errors, because a median cannot be computed from those of batches. With several processes (DDP)
    the errors of all are gathered before `compute`, each pose once.
    """

    is_differentiable = False
    higher_is_better = None
    full_state_update = False

    position_error_m: list[Tensor]
    orientation_error_deg: list[Tensor]
    keys: list[Tensor]

    def __init__(self) -> None:
        super().__init__()
        self.add_state("position_error_m", default=[], dist_reduce_fx="cat")
        self.add_state("orientation_error_deg", default=[], dist_reduce_fx="cat")
        self.add_state("keys", default=[], dist_reduce_fx="cat")

    def update(
        self, position_hat: Tensor, quat_hat: Tensor, position: Tensor, quat: Tensor, keys: Tensor | None = None
    ) -> None:
        """Add frames.

        Args:
            position_hat: (..., 3) predicted, metres.
            quat_hat: (..., 4) predicted wxyz, of any length and sign.
            position: (..., 3) true, metres.
            quat: (..., 4) true wxyz.
            keys: (...) int64, as `key_poses` returns them: of poses that several processes added, one counts; all
                count if not given.
        """
        position_error = position_error_m(_promote_to_float32(position_hat), _promote_to_float32(position))
        orientation_error = orientation_error_deg(_promote_to_float32(quat_hat), _promote_to_float32(quat))
        self.position_error_m.append(position_error.detach().flatten())
        self.orientation_error_deg.append(orientation_error.detach().flatten())
        self.keys.append(
            torch.full_like(position_error, -1, dtype=torch.int64).flatten() if keys is None else keys.flatten()
        )

    def compute(self) -> dict[str, float]:
        """The summary of all frames.

        Raises:
            ConfigError: no frame was added.
        """
        errors = _join_state(self.position_error_m), _join_state(self.orientation_error_deg)
        if isinstance(self.keys, Tensor):  # gathered from several processes
            chosen = select_unique(self.keys)
            errors = errors[0][chosen], errors[1][chosen]
        return summarize_errors(*errors)


def _promote_to_float32(x: Tensor) -> Tensor:
    """At least single precision: the half precision of autocast would round metres to centimetres."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


def _join_state(state: list[Tensor] | Tensor) -> Tensor:
    """One vector from a state, which is a list before the processes' parts are gathered and a tensor afterwards."""
    return state if isinstance(state, Tensor) else torch.cat([torch.empty(0), *(s.cpu() for s in state)])
