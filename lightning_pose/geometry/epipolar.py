"""Epipolar geometry of two posed cameras: essential matrices, and how far matches lie from their epipolar lines."""

from __future__ import annotations

import numpy as np

__all__ = ["essential_matrices", "sampson_distances_px"]


def essential_matrices(
    rotation_a: np.ndarray, position_a: np.ndarray, rotation_b: np.ndarray, position_b: np.ndarray
) -> np.ndarray:
    """Essential matrices E of N pairs of cameras: x_b^T E x_a = 0 for the rays x_a and x_b to one point.

    Hartley & Zisserman, "Multiple View Geometry", section 9.6: E = [t]_x R, with t of unit length here.

    Args:
        rotation_a: (N, 3, 3), camera-to-world rotations of the first cameras.
        position_a: (N, 3), their centres.
        rotation_b: (N, 3, 3), of the second cameras.
        position_b: (N, 3).

    Returns:
        (N, 3, 3) float64. All zeros for a pair whose cameras share a centre: it has no epipolar lines.

    >>> E = essential_matrices(np.eye(3)[None], np.zeros((1, 3)), np.eye(3)[None], np.array([[1.0, 0, 0]]))
    >>> float(np.array([0.2, 0.3, 1]) @ E[0] @ np.array([0.5, 0.3, 1]))  # b is right of a: points move left, not up
    0.0
    """
    world_to_b = np.swapaxes(rotation_b, -1, -2)
    relative = world_to_b @ rotation_a
    translation = np.einsum("nij,nj->ni", world_to_b, position_a - position_b)
    length = np.linalg.norm(translation, axis=1, keepdims=True)
    x, y, z = np.divide(translation, length, out=np.zeros_like(translation), where=length > 0).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    return cross @ relative


def sampson_distances_px(
    essential: np.ndarray, points_a_px: np.ndarray, points_b_px: np.ndarray, focal_px: float
) -> np.ndarray:
    """Sampson distances of M matches, in pixels: to first order, how far both points are from a common ray plane.

    Hartley & Zisserman, section 11.4.3.

    Args:
        essential: (M, 3, 3), the essential matrix of each match's pair.
        points_a_px: (M, 2), pixels from the principal point, in the first image.
        points_b_px: (M, 2), in the second image.
        focal_px: focal length of both cameras.

    Returns:
        (M,) float64, at least 0; nan where the essential matrix is zero.
    """
    rays_a, rays_b = (np.column_stack([p / focal_px, np.ones(len(p))]) for p in (points_a_px, points_b_px))
    lines_b = np.einsum("mij,mj->mi", essential, rays_a)
    lines_a = np.einsum("mij,mi->mj", essential, rays_b)
    gradient = (lines_a[:, :2] ** 2 + lines_b[:, :2] ** 2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return focal_px * np.abs((rays_b * lines_b).sum(axis=1)) / np.sqrt(gradient)
