"""The pose loss in all forms of the thesis, and with learned weights."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lightning_pose.errors import ConfigError
from lightning_pose.geometry.quaternions import quat_normalize

__all__ = ["LossConfig", "PoseLoss"]

Form = Literal["joint", "split"]
Norm = Literal["plain", "squared"]


@dataclass
class LossConfig:
    """Settings of the pose loss; the defaults are the thesis's eq. 2.1 and 3.7.

    Eq. 4.4 is `form: split` with `orientation_weight` alpha; 5.3 the same with `normalize_quat`; 6.3 is
    `split`, `squared`, with `orientation_weight` beta; 6.2 adds `trajectory_weight: 1`.

    Attributes:
        form: `joint` is the norm of the 7-vector's error, `split` the norm of the position's error plus
            that of the quaternion's.
        norm: `plain` is the Euclidean norm, `squared` its square.
        orientation_weight: how much the quaternion counts: the factor of its term in `split` (alpha and
            beta of the thesis), of its four elements in `joint`.
        trajectory_weight: for clips, the factor of the norm of the positions' summed error; 0 leaves it out.
        learned_weights: learn the weights of position and orientation (Kendall & Cipolla, CVPR 2017); needs
            `split` and `orientation_weight` 1.
        normalize_quat: scale the predicted quaternion to unit length first.

    Raises:
        ConfigError: a value is out of range, or two contradict each other.
    """

    form: Form = "joint"
    norm: Norm = "plain"
    orientation_weight: float = 1.0
    trajectory_weight: float = 0.0
    learned_weights: bool = False
    normalize_quat: bool = False

    def __post_init__(self) -> None:
        for name, choices in (("form", get_args(Form)), ("norm", get_args(Norm))):
            if getattr(self, name) not in choices:
                raise ConfigError(f"{name} is {getattr(self, name)!r}; give one of {', '.join(choices)}")
        for name in ("orientation_weight", "trajectory_weight"):
            weight = getattr(self, name)
            if not (math.isfinite(weight) and weight >= 0):
                raise ConfigError(f"{name} is {weight}; give a finite number, 0 or more")
        if self.learned_weights and self.form != "split":
            raise ConfigError(f"learned_weights needs two terms but form is {self.form!r}; set form: split")
        if self.learned_weights and self.orientation_weight != 1:
            raise ConfigError(
                f"orientation_weight is {self.orientation_weight} but learned_weights learns it; "
                "set orientation_weight: 1, or learned_weights: false"
            )


class PoseLoss(nn.Module):
    """Position error plus weighted orientation error (see `LossConfig`); each term is a mean over batch and frames.

    With learned weights the total is `L_p exp(-s_p) + s_p + L_q exp(-s_q) + s_q` (Kendall & Cipolla,
    CVPR 2017); s_p starts at 0, s_q at -3. The gradient of an error of zero is zero.

    Args:
        config: the loss's form and weights.
    """

    def __init__(self, config: LossConfig | None = None) -> None:
        super().__init__()
        self.config = config or LossConfig()
        if self.config.learned_weights:
            self.log_scale_position = nn.Parameter(torch.tensor(0.0))
            self.log_scale_orientation = nn.Parameter(torch.tensor(-3.0))

    def forward(
        self,
        position_hat: Float[Tensor, "*predicted 3"],
        quat_hat: Float[Tensor, "*predicted 4"],
        position: Float[Tensor, "*true 3"],
        quat: Float[Tensor, "*true 4"],
        by_item: bool = False,
    ) -> dict[str, Float[Tensor, "*items"]]:
        """The loss of predicted poses, and its terms.

        Args:
            position_hat: predicted; (B, T, 3) for clips.
            quat_hat: predicted wxyz, as the network returns it.
            position: true, of the same shape.
            quat: true wxyz, unit, in one hemisphere.
            by_item: return each term as (B,), one value for each frame or clip; their mean is the loss.

        Returns:
            `position` and `orientation`, unweighted; `trajectory`, unweighted, if it has a weight; and `total`.

        Raises:
            ConfigError: shapes differ, or there is a trajectory weight but no time axis.
        """
        config = self.config
        if position_hat.shape != position.shape or quat_hat.shape != quat.shape:
            raise ConfigError(
                f"predictions are {tuple(position_hat.shape)} and {tuple(quat_hat.shape)} but targets "
                f"{tuple(position.shape)} and {tuple(quat.shape)}; give both the same shape"
            )
        if config.normalize_quat:
            quat_hat = quat_normalize(quat_hat)
        error_p, error_q = position_hat - position, quat_hat - quat
        mean = _mean_by_item if by_item else torch.mean
        terms = {"position": mean(self._norm(error_p)), "orientation": mean(self._norm(error_q))}
        if config.trajectory_weight:
            terms["trajectory"] = mean(self._trajectory(error_p))
        drift = config.trajectory_weight * terms.get("trajectory", 0.0)
        if config.form == "joint":
            error = torch.cat([error_p, config.orientation_weight * error_q], dim=-1)
            total = mean(self._norm(error)) + drift
        elif config.learned_weights:
            s_p, s_q = self.log_scale_position, self.log_scale_orientation
            total = (terms["position"] + drift) * torch.exp(-s_p) + s_p
            total = total + terms["orientation"] * torch.exp(-s_q) + s_q
        else:
            total = terms["position"] + drift + config.orientation_weight * terms["orientation"]
        return {**terms, "total": total}

    def _norm(self, error: Tensor) -> Tensor:
        """Norm of errors (..., D), plain or squared as configured: (...)."""
        if self.config.norm == "squared":
            return error.square().sum(-1)
        # Its gradient at 0 is 0; that of the square root of a sum of squares is NaN.
        return torch.linalg.vector_norm(error, dim=-1)

    def _trajectory(self, error_p: Tensor) -> Tensor:
        """Norm of each clip's position error summed over its T frames, divided by T.

        Eq. 6.2 sums its position and orientation terms over the T frames; here they are means. With this term divided
        by T as well, the total is eq. 6.2 divided by T.
        """
        if error_p.dim() < 3:
            raise ConfigError(
                f"trajectory_weight is {self.config.trajectory_weight} but the positions, "
                f"{tuple(error_p.shape)}, have no time axis; use clips (B, T, 3) or set trajectory_weight: 0"
            )
        return self._norm(error_p.sum(-2)) / error_p.shape[-2]


def _mean_by_item(values: Tensor) -> Tensor:
    """(B, ...) -> (B,)."""
    return values if values.ndim == 1 else values.flatten(1).mean(1)
