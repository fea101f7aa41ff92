"""How far away the things are that frames see: from their matches, or, before there are any, from their poses alone."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from lightning_pose.mapping.frames import MapFrames
from lightning_pose.mapping.pairs import MOST_COMPARED, choose_pairs
from lightning_pose.mapping.track_points import find_tracks

__all__ = ["estimate_depth", "measure_depth"]

SAMPLED = 40
"""Frames, evenly spread, that are matched with their partners to measure the distance."""

FEWEST_SEEN, FEWEST_TRACKS = 3, 50
"""Frames that must see a point, and points that say how far away things are."""

GROUPS, GROUP = 50, 200
"""Of more than `MOST_COMPARED` frames, so many groups of so many near each other are looked at."""


def measure_depth(frames: MapFrames) -> float:
    """Median distance at which some frames see the points that they match; `estimate_depth` if these are too few.

    Args:
        frames: with poses and keypoints.
    """
    estimated = estimate_depth(frames.rotation, frames.position)
    pairs = choose_pairs(frames, estimated).pairs
    sample = np.linspace(0, len(frames) - 1, SAMPLED).round().astype(int)
    tracks = find_tracks(frames, pairs[np.isin(pairs, sample).any(axis=1)], FEWEST_SEEN)
    if len(tracks.points) < FEWEST_TRACKS:
        return estimated
    return float(np.median(np.linalg.norm(tracks.points[tracks.track] - frames.position[tracks.frame], axis=1)))


def estimate_depth(rotation: np.ndarray, position: np.ndarray) -> float:
    """A typical distance from the cameras to what they see: to the point that is nearest to all optical axes.

    Needs no scale. Where the axes do not meet (a camera that looks outward as it goes), the point lies behind many
    cameras, and the distance is of the order of the path's extent. More than `MOST_COMPARED` frames may be of many
    rooms: the distance is then the median of those in groups of near frames.

    Args:
        rotation: (F, 3, 3), camera-to-world.
        position: (F, 3).

    Returns:
        the median distance, above 0.
    """
    if len(position) > MOST_COMPARED:
        middle = np.linspace(0, len(position) - 1, GROUPS).round().astype(int)
        groups = np.asarray(KDTree(position).query(position[middle], GROUP)[1])
        return float(np.median([estimate_depth(rotation[group], position[group]) for group in groups]))
    axis = rotation[:, :, 2]
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    normal = across.sum(axis=0)
    meeting = np.linalg.lstsq(normal, (across @ position[:, :, None]).sum(axis=0)[:, 0], rcond=1e-9)[0]
    depth = float(np.median(np.linalg.norm(position - meeting, axis=1)))
    extent = float(np.linalg.norm(np.ptp(position, axis=0)))
    return max(depth, extent * 1e-3, np.finfo(float).tiny)
