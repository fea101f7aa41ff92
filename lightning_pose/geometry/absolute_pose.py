"""The pose of one camera from points whose places in the world and in the image are known."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

__all__ = ["CameraPose", "RefinedPose", "derive_pose", "find_pose_ransac", "refine_pose", "solve_scaled"]

MAX_ITERATIONS = 1000
CONFIDENCE = 0.9999


class CameraPose(NamedTuple):
    """Camera-to-world rotation (3, 3), and the camera's centre (3,)."""

    rotation: np.ndarray
    position: np.ndarray


class RefinedPose(NamedTuple):
    """A pose with the normal matrix of its last step.

    Attributes:
        pose: the pose.
        normal: (6, 6), J^T W J of the errors in units of `sigma`, over a rotation in the camera's axes (radians) and
            a movement in the world's.
    """

    pose: CameraPose
    normal: np.ndarray


def find_pose_ransac(
    points: np.ndarray, observed: np.ndarray, threshold: float, iterations: int = MAX_ITERATIONS
) -> tuple[CameraPose, np.ndarray] | None:
    """The pose on which most points agree: AP3P (Ke & Roumeliotis, CVPR 2017) within RANSAC.

    Args:
        points: (N, 3), in the world.
        observed: (N, 2), normalised image coordinates.
        threshold: largest image error of an inlier, in normalised image coordinates.
        iterations: samples of four points that are tried at most.

    Returns:
        the pose and the (N,) mask of its inliers; None if fewer than four points are given or agree.
    """
    if len(points) < 4:
        return None
    origin = points.mean(axis=0)  # far from zero, squares of coordinates lose the digits that matter
    found, turn, shift, inliers = cv2.solvePnPRansac(
        np.ascontiguousarray(points - origin),
        np.ascontiguousarray(observed),
        np.eye(3),
        None,
        iterationsCount=iterations,
        reprojectionError=threshold,
        confidence=CONFIDENCE,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or inliers is None or len(inliers) < 4 or not (np.isfinite(turn).all() and np.isfinite(shift).all()):
        return None
    to_camera = Rotation.from_rotvec(turn[:, 0]).as_matrix()
    mask = np.zeros(len(points), bool)
    mask[inliers[:, 0].astype(np.int64)] = True
    return CameraPose(to_camera.T, origin - to_camera.T @ shift[:, 0]), mask


def refine_pose(
    pose: CameraPose, points: np.ndarray, observed: np.ndarray, sigma: float | np.ndarray, steps: int = 8
) -> RefinedPose:
    """Gauss-Newton on the image errors with Cauchy's weights.

    Args:
        pose: where to start.
        points: (N, 3), in the world.
        observed: (N, 2), normalised image coordinates.
        sigma: scale of Cauchy's weights, in normalised image coordinates; one, or (N,).
        steps: at most; fewer when the pose no longer moves.
    """
    rotation, position = pose
    normal = np.zeros((6, 6))
    jacobian = np.empty((6, 2, len(points)))
    for _ in range(steps):
        x, y, z = rotation.T @ (points - position).T
        one = 1 / np.maximum(z, 1e-9)
        u, v = x * one, y * one
        error = np.stack([u, v]) - observed.T
        weight = 1 / (1 + (error**2).sum(axis=0) / sigma**2) / sigma**2
        derive_pose(jacobian, rotation, u, v, one)
        weighted = (jacobian * weight).reshape(6, -1)
        normal = weighted @ jacobian.reshape(6, -1).T
        right = weighted @ error.ravel()
        step = -solve_scaled(normal, right)
        rotation = rotation @ cv2.Rodrigues(step[:3])[0]  # several times as fast as scipy's `Rotation`
        position = position + step[3:]
        if np.abs(step[:3]).max() < 1e-7 and np.abs(step[3:]).max() < 1e-7 * float(np.median(z)):
            break
    return RefinedPose(CameraPose(rotation, position), normal)


def derive_pose(jacobian: np.ndarray, rotation: np.ndarray, u: np.ndarray, v: np.ndarray, by_depth: np.ndarray) -> None:
    """Write by how much points move in the image as the camera moves.

    Turning it by w, in its own axes, moves a local point by local x w; moving it by d moves the point by -R^T d.

    Args:
        jacobian: (6 or more, 2, N); the first 6 rows are written: the turn's and the movement's.
        rotation: (3, 3), camera-to-world.
        u: (N,), of the points in the image.
        v: (N,).
        by_depth: (N,), inverse depths.
    """
    uv = u * v
    jacobian[:3, 0] = uv, -1 - u * u, v
    jacobian[:3, 1] = 1 + v * v, -uv, -u
    jacobian[3:6, 0] = np.outer(rotation[:, 2], u * by_depth) - np.outer(rotation[:, 0], by_depth)
    jacobian[3:6, 1] = np.outer(rotation[:, 2], v * by_depth) - np.outer(rotation[:, 1], by_depth)


def solve_scaled(normal: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(K,) solution of normal equations (K, K).

    They are scaled to a unit diagonal: radians and the scene's unit differ by orders of magnitude. With 1e-12 on the
    diagonal, what they leave open stays as it is, as with `lstsq`, in a tenth of its time.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return scale * np.linalg.solve(normal * np.outer(scale, scale) + 1e-12 * np.eye(len(scale)), right * scale)
