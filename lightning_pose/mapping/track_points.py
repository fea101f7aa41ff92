"""Points of a map: tracks of keypoints from matched pairs of frames, triangulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from lightning_pose.geometry.triangulation import (
    find_midpoints,
    refine_points,
    reprojection_errors,
    widest_angles_deg,
)
from lightning_pose.mapping.depth_vote import vote_depths
from lightning_pose.mapping.frames import MapFrames
from lightning_pose.mapping.guided_matching import match_pairs
from lightning_pose.mapping.threads import map_in_threads
from lightning_pose.mapping.tracks import join_tracks

__all__ = ["GATES_PX", "Tracks", "find_rays", "find_tracks", "triangulate_tracks"]

MIN_ANGLE_DEG = 1.5
"""Angle between the widest rays of a point."""

HUBER_PX = 1.5
"""An observation counts in full up to this error."""

PART = 2**14
"""Observations whose tracks are refined at once: as many as fit a processor's cache."""

GATES_PX = (12.0, 6.0, 3.0)
"""Observations farther than this from their point are left out, gate after gate."""


@dataclass(frozen=True)
class Tracks:
    """O observations of T points.

    Attributes:
        track: (O,) int64, ascending.
        frame: (O,) int64.
        keypoint: (O,) int64, row in the frame.
        points: (T, 3) float64, where each point is.
        fewest: observations that a point must have.
    """

    track: np.ndarray
    frame: np.ndarray
    keypoint: np.ndarray
    points: np.ndarray
    fewest: int

    def select(self, observations: np.ndarray) -> Tracks:
        """These observations (a mask), and the points that they see, numbered anew."""
        kept, track = np.unique(self.track[observations], return_inverse=True)
        return Tracks(track, self.frame[observations], self.keypoint[observations], self.points[kept], self.fewest)


def find_tracks(frames: MapFrames, pairs: np.ndarray, fewest: int) -> Tracks:
    """Match pairs (P, 2) of frames: tracks of at least so many keypoints, at the least squares point of their rays."""
    matches = match_pairs(frames, pairs)
    matches = matches.select(vote_depths(frames, matches))
    track, frame, keypoint = join_tracks(matches, frames.points.shape[1], fewest)
    n_tracks = int(track[-1]) + 1 if len(track) else 0
    points = find_midpoints(track, frames.position[frame], find_rays(frames, frame, keypoint), n_tracks)
    return Tracks(track, frame, keypoint, points, fewest)


def triangulate_tracks(frames: MapFrames, tracks: Tracks, gates_px: Sequence[float] = GATES_PX) -> Tracks:
    """Refined points, with the observations that agree with them; points with too few, or too narrow ones, are gone."""
    for gate_px in gates_px:
        frame, observed = tracks.frame, frames.points[tracks.frame, tracks.keypoint]
        centre, rotation, focal_px = frames.position[frame], frames.rotation[frame], frames.focal_px[frame]
        points = _refine_in_parts(tracks, (centre, rotation, observed, HUBER_PX / focal_px))
        error = np.linalg.norm(reprojection_errors(points[tracks.track], centre, rotation, observed), axis=1)
        near = error * focal_px <= gate_px
        count = np.bincount(tracks.track[near], minlength=len(points))
        near &= count[tracks.track] >= tracks.fewest
        tracks = replace(tracks, points=points).select(near)
    rays = find_rays(frames, tracks.frame, tracks.keypoint)
    wide = widest_angles_deg(tracks.track, rays, len(tracks.points)) >= MIN_ANGLE_DEG
    return tracks.select(wide[tracks.track])


def _refine_in_parts(tracks: Tracks, columns: tuple[np.ndarray, ...]) -> np.ndarray:
    """`refine_points` of some tracks at a time; `columns` are what it takes of each observation."""
    starts = np.unique(tracks.track[::PART])

    def refine(first: int, last: int) -> np.ndarray:
        rows = slice(*np.searchsorted(tracks.track, [first, last]))
        centre, rotation, observed, huber = (each[rows] for each in columns)
        return refine_points(tracks.points[first:last], tracks.track[rows] - first, centre, rotation, observed, huber)

    parts = map_in_threads(lambda ends: refine(*ends), pairwise([*starts.tolist(), len(tracks.points)]))
    return np.concatenate([tracks.points[:0], *parts])


def find_rays(frames: MapFrames, frame: np.ndarray, keypoint: np.ndarray) -> np.ndarray:
    """(O, 3) unit directions in the world of keypoints `keypoint` of frames `frame`."""
    local = np.column_stack([frames.points[frame, keypoint], np.ones(len(frame))])
    rays = np.einsum("oij,oj->oi", frames.rotation[frame], local)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
