"""Mean and spread of training poses and of training features: what standardization subtracts and divides by."""

from __future__ import annotations

import torch
from torch import Tensor

from lightning_pose.geometry.quaternions import align_hemisphere

__all__ = ["measure_columns", "measure_poses"]

SMALLEST = 1e-6  # a spread of zero would divide by zero
MOST_FRAMES = 1000
MOST_ELEMENTS = 2**25  # of the features that columns are measured on, where frames are large


def measure_poses(position_m: Tensor, quat_wxyz: Tensor, quat_reference: Tensor) -> tuple[Tensor, Tensor]:
    """Mean pose and spread of poses, quaternions taken on the hemisphere of a reference.

    The three axes of the position have one spread, and the four components of the quaternion another, so that
    distances keep their shape.

    Args:
        position_m: (M, 3).
        quat_wxyz: (M, 4), unit.
        quat_reference: (4,), unit.

    Returns:
        mean (7,) and spread (7,), position first; no spread is below 1e-6.
    """
    poses = torch.cat([position_m, align_hemisphere(quat_wxyz, quat_reference)], dim=-1)
    mean, spread = poses.mean(0), torch.empty_like(poses[0])
    for part in (slice(0, 3), slice(3, 7)):
        spread[part] = (poses[:, part] - mean[part]).square().mean().sqrt().clamp(min=SMALLEST)
    return mean, spread


def measure_columns(features: Tensor, axis: int) -> tuple[Tensor, Tensor] | None:
    """Mean and standard deviation of each column of features, over frames and all other axes.

    Rows of zeros, where a frame had fewer features, do not count. At most 1000 frames are used, evenly spaced, and
    fewer where frames are large.

    Args:
        features: (M, ...).
        axis: the axis of the columns, counted from the last.

    Returns:
        mean (D,) and deviation (D,), at least 1e-6; None if fewer than two rows count.
    """
    frames = min(MOST_FRAMES, max(1, MOST_ELEMENTS // max(1, features[0].numel())))
    rows = features[:: -(-len(features) // frames)].movedim(axis, -1).flatten(0, -2)
    rows = rows[rows.any(1)].float()
    return (rows.mean(0), rows.std(0).clamp(min=SMALLEST)) if len(rows) > 1 else None
