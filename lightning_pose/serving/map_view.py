"""The map from above: points and training cameras in a plane, for the page."""

from __future__ import annotations

import numpy as np

from lightning_pose.serving.service import Json

__all__ = ["find_plane", "view_from_above"]

MAX_POINTS, MAX_CAMERAS = 4000, 400
"""How many of each are drawn; evenly chosen where there are more."""

SHARE = 1.0
"""Per cent of the points at each end of an axis that may lie outside the drawing: single points are far off."""

MARGIN = 0.08

LEAST_AGREEMENT = 0.3
"""Length of the mean of the cameras' downward axes below which they do not say where down is."""


def find_plane(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """The ground's axes in the world, as seen from above: to the right, and up on the page.

    Up is against the mean of the cameras' downward axes; where cameras look in all directions it is that in which their
    positions vary least.

    Args:
        rotation: (F, 3, 3), camera-to-world, OpenCV axes.
        position: (F, 3).

    Returns:
        (2, 3), unit and orthogonal; right x up-on-the-page = up.

    >>> find_plane(np.array([[[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]]), np.zeros((1, 3))).tolist()  # z is up
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """
    up = -rotation[:, :, 1].mean(0)
    if np.linalg.norm(up) < LEAST_AGREEMENT:
        up = np.linalg.svd(position - position.mean(0))[2][-1]
    up = up / np.linalg.norm(up)
    right = np.eye(3)[np.argmin(np.abs(up))] if abs(up[0]) > 0.9 else np.array([1.0, 0, 0])
    right = right - up * (right @ up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right)]) + 0.0  # no negative zeros


def view_from_above(points: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> Json:
    """What the page draws.

    Args:
        points: (P, 3) of the map in the world.
        rotation: (F, 3, 3) of the training cameras, camera-to-world.
        position: (F, 3).

    Returns:
        `axes` (2, 3), with which the page projects an answer; `points` (N, 2); `cameras` (M, 4), each a place and a
        direction of view; `box`, the drawing's left, bottom, right and top. In the scene's unit.
    """
    axes = find_plane(rotation, position)
    flat, places = points @ axes.T, position @ axes.T
    directions = rotation[:, :, 2] @ axes.T
    inner = np.percentile(flat, [SHARE, 100 - SHARE], axis=0) if len(flat) else np.zeros((0, 2))
    corners = np.concatenate([inner, places])
    low, high = corners.min(0), corners.max(0)
    margin = max(*(high - low), 1e-6) * MARGIN
    return {
        "axes": axes.tolist(),
        "points": _choose(flat, MAX_POINTS),
        "cameras": _choose(np.hstack([places, directions]), MAX_CAMERAS),
        "box": [*(low - margin).tolist(), *(high + margin).tolist()],
    }


def _choose(rows: np.ndarray, count: int) -> list[list[float]]:
    """At most this many rows, evenly chosen, to four digits after the point of the largest."""
    step = -(-len(rows) // count) or 1
    scale = float(np.abs(rows).max()) if rows.size else 1.0
    digits = 4 - int(np.floor(np.log10(scale))) if scale > 0 else 4
    return rows[::step].round(max(digits, 0)).tolist()
