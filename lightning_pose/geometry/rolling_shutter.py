"""Images of a camera that turns while its rows are read one after the other, as most cameras' are.

A row at y (normalised image coordinates) is taken while the camera has turned by y times `turn` from where it stood at
the row of the principal point: Hedborg, Forssén, Felsberg, Ringaby, "Rolling Shutter Bundle Adjustment", CVPR 2012,
without their movement of the camera's centre, which at hand-held speeds is below what a map resolves.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from lightning_pose.geometry.absolute_pose import CameraPose, derive_pose, solve_scaled

__all__ = ["TurningPose", "refine_turning_pose", "remove_rolling"]


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


def remove_rolling(points: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Where (..., 2) points would lie if the camera had stood still; `turn` (..., 3) is that of each point's image."""
    u, v = np.moveaxis(points, -1, 0)
    turn_x, turn_y, turn_z = np.moveaxis(np.asarray(turn), -1, 0)
    still_u, still_v = u, v
    for _ in range(2):  # as the camera turns by w in its own axes, a local point x moves by x x w
        uv = still_u * still_v
        moved_u = uv * turn_x - (1 + still_u * still_u) * turn_y + still_v * turn_z
        moved_v = (1 + still_v * still_v) * turn_x - uv * turn_y - still_u * turn_z
        still_u, still_v = u - moved_u * v, v - moved_v * v
    return np.stack([still_u, still_v], axis=-1)


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
    normal, right = np.zeros((9, 9)), np.zeros(9)
    jacobian, y_turn = np.empty((9, 2, len(points))), turn_sd * observed[:, 1]
    for _ in range(steps):
        x, y, z = rotation.T @ (points - position).T
        one = 1 / np.maximum(z, 1e-9)
        u, v = x * one, y * one
        derive_pose(jacobian, rotation, u, v, one)
        jacobian[6:] = jacobian[:3] * y_turn
        error = np.stack([u, v]) + np.tensordot(turn, jacobian[6:], 1) - observed.T
        weight = 1 / (1 + (error**2).sum(axis=0) / sigma**2) / sigma**2
        weighted = (jacobian * weight).reshape(9, -1)
        normal = weighted @ jacobian.reshape(9, -1).T
        right = weighted @ error.ravel()
        normal[6:, 6:] += np.eye(3)
        right[6:] += turn
        step = -solve_scaled(normal, right)
        rotation = rotation @ cv2.Rodrigues(step[:3])[0]  # several times as fast as scipy's `Rotation`
        position = position + step[3:6]
        turn = turn + step[6:]
        if np.abs(step[:3]).max() < 1e-7 and np.abs(step[3:6]).max() < 1e-7 * float(np.median(z)):
            break
    both = normal[:6, 6:]
    of_pose = normal[:6, :6] - both @ np.linalg.solve(normal[6:, 6:], both.T)
    return TurningPose(CameraPose(rotation, position), of_pose, turn * turn_sd)
