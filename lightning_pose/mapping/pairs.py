"""Which pairs of frames to match: those that see the same things from places far enough apart."""

from __future__ import annotations

import numpy as np

from lightning_pose.mapping.frames import MapFrames

__all__ = ["FEW_FRAMES", "choose_pairs", "estimate_depth"]

MIN_OVERLAP = 0.4
"""Share of either image that the other must see, at the nominal depth."""

MIN_BASELINE = 0.015
"""Distance between the cameras, in nominal depths; below it depths are too uncertain to help."""

PARTNERS = 8
"""Partners chosen for each frame, spread evenly from the nearest to the farthest. 12 took longer and gained nothing."""

PARTNERS_OF_FEW = 20
"""The same where there are at most `FEW_FRAMES`: photos, in which each point is seen by few."""

FEW_FRAMES = 200

GRID = (7, 5)
"""Points across and down an image that stand for what it sees."""


def estimate_depth(rotation: np.ndarray, position: np.ndarray) -> float:
    """A typical distance from the cameras to what they see: to the point that is nearest to all optical axes.

    Needs no scale. Where the axes do not meet (a camera that looks outward as it goes), the point lies behind many
    cameras, and the distance is of the order of the path's extent.

    Args:
        rotation: (F, 3, 3), camera-to-world.
        position: (F, 3).

    Returns:
        the median distance, above 0.
    """
    axis = rotation[:, :, 2]
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    normal = across.sum(axis=0)
    meeting = np.linalg.lstsq(normal, (across @ position[:, :, None]).sum(axis=0)[:, 0], rcond=1e-9)[0]
    depth = float(np.median(np.linalg.norm(position - meeting, axis=1)))
    extent = float(np.linalg.norm(np.ptp(position, axis=0)))
    return max(depth, extent * 1e-3, np.finfo(float).tiny)


def choose_pairs(frames: MapFrames, depth: float) -> np.ndarray:
    """Pairs of frames to match.

    Args:
        frames: with poses.
        depth: nominal distance of what the frames see.

    Returns:
        (P, 2) int64, first frame below the second, in ascending order.
    """
    partners = PARTNERS if len(frames) > FEW_FRAMES else PARTNERS_OF_FEW
    seen = _measure_overlaps(frames, depth)
    baseline = np.linalg.norm(frames.position[:, None] - frames.position[None], axis=2)
    candidate = (np.minimum(seen, seen.T) >= MIN_OVERLAP) & (baseline >= MIN_BASELINE * depth)
    pairs: set[tuple[int, int]] = set()
    for i, row in enumerate(candidate):
        others = np.flatnonzero(row)
        others = others[np.argsort(baseline[i, others], kind="stable")]
        chosen = np.unique(np.linspace(0, len(others) - 1, partners).round().astype(int)) if len(others) else []
        pairs.update((min(i, j), max(i, j)) for j in others[chosen].tolist())
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)


def _measure_overlaps(frames: MapFrames, depth: float) -> np.ndarray:
    """(F, F): the share of frame i's image, at the nominal depth, that frame j sees.

    A camera sees what lies inside the four planes through its centre and the sides of its image: one product of all
    planes with all points.
    """
    n = len(frames)
    x, y = np.meshgrid(*(np.linspace(-1, 1, count) for count in GRID))
    unit = np.column_stack([x.ravel(), y.ravel()])
    local = np.concatenate([unit * frames.half_view[:, None], np.ones((n, len(unit), 1))], axis=2) * depth
    centre = frames.position - frames.position.mean(axis=0)  # float32 has no digits for a far origin
    world = local @ np.swapaxes(frames.rotation, 1, 2) + centre[:, None]
    points = np.concatenate([world, np.ones((n, len(unit), 1))], axis=2).astype(np.float32)
    outward = np.zeros((n, 4, 3))
    outward[:, [0, 1], 0] = outward[:, [2, 3], 1] = [1, -1]
    outward[:, :, 2] = -frames.half_view[:, [0, 0, 1, 1]]
    normal = outward @ np.swapaxes(frames.rotation, 1, 2)
    offset = -(normal @ centre[:, :, None])
    planes = np.moveaxis(np.concatenate([normal, offset], axis=2), 1, 0).reshape(4 * n, 4).astype(np.float32)
    overlap = np.empty((n, n))
    for i, view in enumerate(points):
        overlap[i] = ((planes @ view.T).reshape(4, n, -1).max(axis=0) <= 0).mean(axis=1)
    return overlap
