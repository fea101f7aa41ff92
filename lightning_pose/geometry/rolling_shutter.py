"""Images of a camera that turns while its rows are read one after the other, as most cameras' are.

A row at y (normalised image coordinates) is taken while the camera has turned by y times `turn` from where it stood at
the row of the principal point: Hedborg, Forssén, Felsberg, Ringaby, "Rolling Shutter Bundle Adjustment", CVPR 2012,
without their movement of the camera's centre, which at hand-held speeds is below what a map resolves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.geometry.absolute_pose import CameraPose

__all__ = ["TurningPose", "derive_rolling", "refine_turning_pose", "remove_rolling"]


class TurningPose(NamedTuple):
    """A pose at the row of the principal point, and how the camera turned.

    Attributes:
        pose: the pose.
        normal: (6, 6), as that of `RefinedPose`; what the unknown turn takes from it is subtracted.
        turn: (3,), rotation vector in the camera's axes, radians in one unit of normalised y.
    """

    pose: CameraPose
    normal: np.ndarray
    turn: np.ndarray


def derive_rolling(points: np.ndarray) -> np.ndarray:
    """(N, 2, 3): by how much (N, 2) points move in the image by turn (radians in one unit of y)."""
    return _derive_turn(points) * points[:, 1, None, None]


def remove_rolling(points: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Where (..., 2) points would lie if the camera had stood still; `turn` (..., 3) is that of each point's image."""
    flat, turns = points.reshape(-1, 2), np.broadcast_to(turn, (*points.shape[:-1], 3)).reshape(-1, 3)
    still = flat
    for _ in range(2):
        still = flat - (_derive_turn(still) @ turns[:, :, None])[:, :, 0] * flat[:, 1:]
    return still.reshape(points.shape)


def refine_turning_pose(
    pose: CameraPose,
    points: np.ndarray,
    observed: np.ndarray,
    sigma: float | np.ndarray,
    turn_sd: float,
    steps: int = 8,
) -> TurningPose:
    """Gauss-Newton with Cauchy's weights, as `refine_pose`, on the pose and on how the camera turned.

    Args:
        pose: where to start.
        points: (N, 3), in the world.
        observed: (N, 2), normalised image coordinates.
        sigma: scale of Cauchy's weights, in normalised image coordinates; one, or (N,).
        turn_sd: standard deviation of each component of the turn, above 0; the prior of a turn is
            normal with mean 0.
        steps: at most; fewer when the pose no longer moves.
    """
    rotation, position = pose
    turn = np.zeros(3)  # in units of turn_sd
    normal = np.zeros((9, 9))
    for _ in range(steps):
        local = (points - position) @ rotation
        depth = np.maximum(local[:, 2:], 1e-9)
        ideal = local[:, :2] / depth
        turned = _derive_turn(ideal)
        rolling = turned * (turn_sd * observed[:, 1, None, None])
        error = ideal + rolling @ turn - observed
        weight = 1 / (1 + (error**2).sum(axis=1) / sigma**2) / sigma**2
        to_image = np.zeros((len(points), 2, 3))
        to_image[:, 0, 0] = to_image[:, 1, 1] = 1
        to_image[:, :, 2] = -ideal
        jacobian = np.concatenate([turned, -(to_image / depth[:, :, None]) @ rotation.T, rolling], axis=2)
        weighted = jacobian * weight[:, None, None]
        normal = np.tensordot(weighted, jacobian, axes=([0, 1], [0, 1]))
        right = np.tensordot(weighted, error, axes=([0, 1], [0, 1]))
        normal[6:, 6:] += np.eye(3)
        right[6:] += turn
        scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        step = -scale * np.linalg.lstsq(normal * np.outer(scale, scale), right * scale, rcond=1e-12)[0]
        rotation = rotation @ Rotation.from_rotvec(step[:3]).as_matrix()
        position = position + step[3:6]
        turn = turn + step[6:]
        if np.abs(step[:3]).max() < 1e-7 and np.abs(step[3:6]).max() < 1e-7 * float(np.median(depth)):
            break
    both = normal[:6, 6:]
    of_pose = normal[:6, :6] - both @ np.linalg.solve(normal[6:, 6:], both.T)
    return TurningPose(CameraPose(rotation, position), of_pose, turn * turn_sd)


def _derive_turn(points: np.ndarray) -> np.ndarray:
    """(N, 2, 3): by how much (N, 2) points move as the camera turns in its own axes: a local point x moves by x x w."""
    u, v = points.T
    return np.stack([u * v, -(1 + u * u), v, 1 + v * v, -u * v, -u], axis=1).reshape(-1, 2, 3)
