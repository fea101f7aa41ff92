"""Baselines for models of clips that use no images: no motion, and constant velocity."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lightning_pose.errors import ConfigError
from lightning_pose.geometry.quaternions import mean_quat, relative_pose
from lightning_pose.geometry.relative import RelativeFrame, chain_steps, check_relative_frame

__all__ = ["predict_constant_velocity", "predict_no_motion"]


def predict_no_motion(clips: int, length: int) -> tuple[Tensor, Tensor]:
    """Zeros (clips, length, 3) and identities (clips, length, 4), float64."""
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    return torch.zeros(clips, length, 3, dtype=torch.float64), identity.repeat(clips, length, 1)


def predict_constant_velocity(
    position_m: Tensor | np.ndarray,
    quat_wxyz: Tensor | np.ndarray,
    length: int,
    relative_frame: RelativeFrame = "camera",
) -> tuple[Tensor, Tensor]:
    """The mean step of the training clips, repeated; a frame that several clips share counts in each.

    A step is the pose of a camera seen from the one before it, with the mean of translations and the mean of
    rotations. In `world` axes the mean translation is one of the world, and is added up as it is.

    Args:
        position_m: (M, T, 3) of training clips, T >= 2; in the world, or relative in the same relative_frame: the
            steps are the same.
        quat_wxyz: (M, T, 4), unit.
        length: frames of the answer.
        relative_frame: axes of the positions, as for `relative_poses`.

    Returns:
        position_m (length, 3) and quat_wxyz (length, 4), float64, relative to the first frame.

    Raises:
        ConfigError: the training clips have no step, or an unknown relative_frame.
    """
    check_relative_frame(relative_frame)
    position, quat = (torch.as_tensor(pose).detach().cpu().double() for pose in (position_m, quat_wxyz))
    if position.dim() != 3 or len(position) < 1 or position.shape[1] < 2:
        raise ConfigError(
            f"training positions of shape {tuple(position.shape)} have no step; give (M, T, 3) with T at least 2"
        )
    moved, turned = relative_pose(position[:, :-1], quat[:, :-1], position[:, 1:], quat[:, 1:])
    if relative_frame == "world":
        moved = position.diff(dim=1)
    step, turn = moved.mean((0, 1)), mean_quat(turned.flatten(0, 1))
    chained, quats = chain_steps(step.expand(1, length - 1, 3), turn.expand(1, length - 1, 4))
    if relative_frame == "world":
        return step * torch.arange(length)[:, None], quats[0]
    return chained[0], quats[0]
