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
    essential: np.ndarray, points_a_px: np.ndarray, points_b_px: np.ndarray, focal_px: float | np.ndarray
) -> np.ndarray:
    """Sampson distances of M matches, in pixels: to first order, how far both points are from a common ray plane.

    Hartley & Zisserman, section 11.4.3.

    Args:
        essential: (M, 3, 3), the essential matrix of each match's pair.
        points_a_px: (M, 2), pixels from the principal point, in the first image.
        points_b_px: (M, 2), in the second image.
        focal_px: focal length of both cameras; or several, (F,), which together take less time than one by one.

    Returns:
        (M,) float64, at least 0; nan where the essential matrix is zero. (F, M) for several focal lengths.
    """
    (x_a, y_a), (x_b, y_b) = points_a_px.T, points_b_px.T
    e = np.ascontiguousarray(np.moveaxis(essential, 0, -1))  # (3, 3, M)
    f = np.asarray(focal_px, np.float64)[..., None]
    # Lines are linear in 1 / f: the rays are (x / f, y / f, 1).
    line_b_x, line_b_y, line_b_w = ((e[i, 0] * x_a + e[i, 1] * y_a) / f + e[i, 2] for i in range(3))
    line_a_x, line_a_y = ((e[0, i] * x_b + e[1, i] * y_b) / f + e[2, i] for i in range(2))
    product = (x_b * line_b_x + y_b * line_b_y) / f + line_b_w
    gradient = line_a_x**2 + line_a_y**2 + line_b_x**2 + line_b_y**2
    with np.errstate(divide="ignore", invalid="ignore"):
        return f * np.abs(product) / np.sqrt(gradient)
