"""A scene of known points, and what cameras that walk through it see: the ground truth of the mapping tests."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from lightning_pose.mapping.frames import MapFrames

__all__ = ["FOCAL_PX", "make_frames", "make_walk"]

FOCAL_PX = 500.0
HALF_VIEW = np.array([0.64, 0.48])
POINTS = 400
DESCRIPTOR = 32


def make_walk(count: int, seed: int = 0, noise_deg: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Camera-to-world rotations (F, 3, 3) and positions (F, 3) in metres: along a wall 3 m away, looking at it."""
    rng = np.random.default_rng(seed)
    along = np.linspace(-1.5, 1.5, count)
    position_m = np.column_stack([along, 0.1 * np.sin(3 * along), 0.2 * np.cos(2 * along)])
    angles = np.column_stack([2 * np.sin(5 * along), 10 * np.sin(2 * along), 3 * np.cos(4 * along)])
    return Rotation.from_euler(
        "xyz", angles + rng.normal(0, noise_deg, (count, 3)), degrees=True
    ).as_matrix(), position_m


def make_frames(
    rotation: np.ndarray,
    position_m: np.ndarray,
    noise_px: float = 0.3,
    clutter: int = 10,
    seed: int = 0,
    origin: np.ndarray | None = None,
    scale: float = 1.0,
) -> MapFrames:
    """Frames of 400 points of a wall as cameras at these poses see them, strongest first.

    Args:
        rotation: (F, 3, 3), true camera-to-world rotations.
        position_m: (F, 3), true camera centres.
        noise_px: standard deviation of the keypoints.
        clutter: keypoints of each frame that are of no point.
        seed: of noise and clutter; the points are always the same.
        origin: added to the positions that the frames carry.
        scale: of the positions that the frames carry.
    """
    world, appearance = np.random.default_rng(99), np.random.default_rng(seed)
    points_m = world.uniform([-3, -1.5, 2.5], [3, 1.5, 4], (POINTS, 3))
    looks = world.normal(size=(POINTS, DESCRIPTOR))
    size_m = world.uniform(0.02, 0.2, POINTS)
    views = []
    for R, c in zip(rotation, position_m, strict=True):
        local = (points_m - c) @ R
        seen = local[:, :2] / local[:, 2:]
        visible = np.flatnonzero((local[:, 2] > 0) & (np.abs(seen) <= HALF_VIEW).all(axis=1))
        spots = seen[visible] + appearance.normal(0, noise_px / FOCAL_PX, (len(visible), 2))
        spots = np.concatenate([spots, appearance.uniform(-HALF_VIEW, HALF_VIEW, (clutter, 2))])
        look = looks[visible] + appearance.normal(0, 0.15, (len(visible), DESCRIPTOR))
        look = np.concatenate([look, appearance.normal(size=(clutter, DESCRIPTOR))])
        size = np.concatenate([size_m[visible] / local[visible, 2] * FOCAL_PX, np.full(clutter, 20.0)])
        views.append((spots, size, look / np.linalg.norm(look, axis=1, keepdims=True)))
    most = max(len(spots) for spots, _, _ in views) + 3
    columns = [np.stack([_pad(view[k], most) for view in views]) for k in range(3)]
    return MapFrames(
        points=columns[0],
        size_px=columns[1].astype(np.float32),
        descriptors=columns[2].astype(np.float32),
        count=np.array([len(spots) for spots, _, _ in views]),
        focal_px=np.full(len(views), FOCAL_PX),
        half_view=np.tile(HALF_VIEW, (len(views), 1)),
        rotation=rotation,
        position=position_m * scale + (0 if origin is None else origin),
    )


def _pad(rows: np.ndarray, length: int) -> np.ndarray:
    return np.concatenate([rows, np.zeros((length - len(rows), *rows.shape[1:]))])
