"""Points in space from the rays of posed cameras."""

from __future__ import annotations

import numpy as np
from scipy import sparse

__all__ = [
    "find_midpoints",
    "find_two_view_depths",
    "make_summation",
    "refine_points",
    "reprojection_errors",
    "sum_by_track",
    "widest_angles_deg",
]


def find_two_view_depths(
    points_a: np.ndarray, points_b: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> np.ndarray:
    """Depth, in camera a, of the point of ray a that lies nearest to ray b.

    Args:
        points_a: (M, 2), normalised image coordinates in camera a.
        points_b: (M, 2), in camera b.
        rotation: (M, 3, 3), from the axes of camera b to those of camera a.
        translation: (M, 3), where camera b stands, in the axes of camera a.

    Returns:
        (M,) z coordinate in camera a; negative where the rays meet behind it, huge where they are parallel.
    """
    ray_a = np.column_stack([points_a, np.ones(len(points_a))])
    ray_b = np.einsum("mij,mj->mi", rotation, np.column_stack([points_b, np.ones(len(points_b))]))
    aa, bb, ab = ((x * y).sum(axis=1) for x, y in ((ray_a, ray_a), (ray_b, ray_b), (ray_a, ray_b)))
    at, bt = (ray_a * translation).sum(axis=1), (ray_b * translation).sum(axis=1)
    return (bb * at - ab * bt) / np.maximum(aa * bb - ab**2, 1e-12)


def find_midpoints(track: np.ndarray, centre: np.ndarray, direction: np.ndarray, n_tracks: int) -> np.ndarray:
    """For each track, the point with the least sum of squared distances to its rays.

    Args:
        track: (O,) int64, the track of each observation, ascending.
        centre: (O, 3), where its camera stands.
        direction: (O, 3), its ray in the world, unit length.
        n_tracks: T, how many tracks there are.

    Returns:
        (T, 3).
    """
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    normal = sum_by_track(track, across.reshape(-1, 9), n_tracks).reshape(-1, 3, 3)
    right = sum_by_track(track, np.einsum("oij,oj->oi", across, centre), n_tracks)
    normal += np.eye(3) * (1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-12)[:, None, None]
    return np.linalg.solve(normal, right[:, :, None])[:, :, 0]


def reprojection_errors(
    points: np.ndarray, centre: np.ndarray, rotation: np.ndarray, observed: np.ndarray
) -> np.ndarray:
    """Projected minus observed, (O, 2) normalised image coordinates; inf where a point lies behind its camera.

    Args:
        points: (O, 3), the point of each observation.
        centre: (O, 3), its camera's centre.
        rotation: (O, 3, 3), camera-to-world.
        observed: (O, 2), normalised image coordinates.
    """
    local = np.einsum("oji,oj->oi", rotation, points - centre)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = local[:, :2] / local[:, 2:] - observed
    return np.where(local[:, 2:] > 0, error, np.inf)


def refine_points(
    points: np.ndarray,
    track: np.ndarray,
    centre: np.ndarray,
    rotation: np.ndarray,
    observed: np.ndarray,
    huber: np.ndarray,
    steps: int = 3,
) -> np.ndarray:
    """Gauss-Newton on the image errors of fixed cameras, with Huber's weights.

    Args:
        points: (T, 3), where each track's point is thought to be.
        track: (O,) int64, the track of each observation, ascending.
        centre: (O, 3), its camera's centre.
        rotation: (O, 3, 3), camera-to-world.
        observed: (O, 2), normalised image coordinates.
        huber: (O,), the error beyond which an observation counts less, in normalised image coordinates.
        steps: of Gauss-Newton.

    Returns:
        (T, 3).
    """
    n, observed = len(points), np.ascontiguousarray(observed.T)
    row_x, row_y, row_z = np.ascontiguousarray(np.moveaxis(rotation, 0, 2).swapaxes(0, 1))  # of world to camera
    centre = np.ascontiguousarray(centre.T)
    row, column = np.triu_indices(3)
    for _ in range(steps):
        away = np.ascontiguousarray(points.T)[:, track] - centre
        x, y, z = ((axis * away).sum(axis=0) for axis in (row_x, row_y, row_z))
        one = 1 / np.maximum(z, 1e-9)
        u, v = x * one, y * one
        error_u, error_v = u - observed[0], v - observed[1]
        size = np.sqrt(error_u**2 + error_v**2)
        weight = np.where(z > 0, np.minimum(1, huber / np.maximum(size, 1e-12)) / huber**2, 0.0)
        # d(projection)/d(point): rows of the world-to-camera rotation, less the projection times its last row, by depth
        by_u, by_v = (row_x - u * row_z) * one, (row_y - v * row_z) * one
        weighted_u, weighted_v = by_u * weight, by_v * weight
        normal, right = np.empty((n, 3, 3)), np.empty((n, 3))
        for i, j in zip(row, column, strict=True):
            total = np.bincount(track, weighted_u[i] * by_u[j] + weighted_v[i] * by_v[j], n)
            normal[:, i, j] = normal[:, j, i] = total
        for i in range(3):
            right[:, i] = np.bincount(track, weighted_u[i] * error_u + weighted_v[i] * error_v, n)
        normal += np.eye(3) * (1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-12)[:, None, None]
        points = points - np.linalg.solve(normal, right[:, :, None])[:, :, 0]
    return points


def widest_angles_deg(track: np.ndarray, direction: np.ndarray, n_tracks: int) -> np.ndarray:
    """(T,) nearly the widest angle between two rays of each track: of the ray farthest from the mean, and its farthest.

    Args:
        track: (O,) int64, ascending.
        direction: (O, 3), unit length.
        n_tracks: T.
    """
    mean = sum_by_track(track, direction, n_tracks)
    for _ in range(2):
        cosine = (direction * mean[track]).sum(axis=1)
        order = np.lexsort((cosine, track))
        first = np.flatnonzero(np.diff(track[order], prepend=-1))
        mean = np.zeros((n_tracks, 3))
        mean[track[order[first]]] = direction[order[first]]
        widest = np.ones(n_tracks)
        widest[track[order[first]]] = cosine[order[first]]
    return np.degrees(np.arccos(np.clip(widest, -1, 1)))


def sum_by_track(track: np.ndarray, values: np.ndarray, n_tracks: int) -> np.ndarray:
    """(T, K) sums of the (O, K) rows of each track, in any order of `track` (O,); the order of summation is fixed."""
    return make_summation(track, n_tracks) @ values


def make_summation(group: np.ndarray, n_groups: int) -> sparse.csc_matrix:
    """(G, O) matrix whose product with (O, K) rows is their sum in each group, faster than numpy's `reduceat`."""
    count = len(group)
    return sparse.csc_matrix((np.ones(count), group, np.arange(count + 1)), shape=(n_groups, count))
