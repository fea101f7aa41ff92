"""Building a landmark map from posed frames with keypoints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lightning_pose.geometry.triangulation import (
    find_midpoints,
    refine_points,
    reprojection_errors,
    sum_by_track,
    widest_angles_deg,
)
from lightning_pose.mapping.depth_vote import vote_depths
from lightning_pose.mapping.frames import MapFrames
from lightning_pose.mapping.guided_matching import match_pairs
from lightning_pose.mapping.landmark_map import LandmarkMap, quantize_descriptors
from lightning_pose.mapping.pairs import choose_pairs, estimate_depth
from lightning_pose.mapping.tracks import join_tracks

__all__ = ["Tracks", "build_landmark_map", "find_tracks", "summarize_tracks", "triangulate_tracks"]

MIN_OBSERVATIONS = 5
"""Frames that must see a point. (3 doubles the map and gains nothing.)"""

MIN_ANGLE_DEG = 1.5
"""Angle between the widest rays of a point."""

HUBER_PX = 1.5
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
    """

    track: np.ndarray
    frame: np.ndarray
    keypoint: np.ndarray
    points: np.ndarray

    def select(self, observations: np.ndarray) -> Tracks:
        """These observations (a mask), and the points that they see, numbered anew."""
        kept, track = np.unique(self.track[observations], return_inverse=True)
        return Tracks(track, self.frame[observations], self.keypoint[observations], self.points[kept])


def build_landmark_map(frames: MapFrames) -> LandmarkMap:
    """The map of posed frames: pairs, guided matches, depth vote, tracks, triangulation.

    Args:
        frames: with poses that are taken as they are.
    """
    return summarize_tracks(frames, triangulate_tracks(frames, find_tracks(frames)))


def find_tracks(frames: MapFrames) -> Tracks:
    """Tracks of keypoints, at the least squares point of their rays."""
    pairs = choose_pairs(frames, estimate_depth(frames.rotation, frames.position))
    matches = match_pairs(frames, pairs)
    matches = matches.select(vote_depths(frames, matches))
    track, frame, keypoint = join_tracks(matches, frames.points.shape[1], MIN_OBSERVATIONS)
    n_tracks = int(track[-1]) + 1 if len(track) else 0
    points = find_midpoints(track, frames.position[frame], find_rays(frames, frame, keypoint), n_tracks)
    return Tracks(track, frame, keypoint, points)


def triangulate_tracks(frames: MapFrames, tracks: Tracks) -> Tracks:
    """Refined points, with the observations that agree with them; points with too few, or too narrow ones, are gone."""
    for gate_px in GATES_PX:
        frame, observed = tracks.frame, frames.points[tracks.frame, tracks.keypoint]
        centre, rotation, focal_px = frames.position[frame], frames.rotation[frame], frames.focal_px[frame]
        points = refine_points(tracks.points, tracks.track, centre, rotation, observed, HUBER_PX / focal_px)
        error = np.linalg.norm(reprojection_errors(points[tracks.track], centre, rotation, observed), axis=1)
        near = error * focal_px <= gate_px
        count = np.bincount(tracks.track[near], minlength=len(points))
        near &= count[tracks.track] >= MIN_OBSERVATIONS
        tracks = Tracks(tracks.track, frame, tracks.keypoint, points).select(near)
    rays = find_rays(frames, tracks.frame, tracks.keypoint)
    wide = widest_angles_deg(tracks.track, rays, len(tracks.points)) >= MIN_ANGLE_DEG
    return tracks.select(wide[tracks.track])


def summarize_tracks(frames: MapFrames, tracks: Tracks) -> LandmarkMap:
    """What the map keeps of each point."""
    n = len(tracks.points)
    count = np.bincount(tracks.track, minlength=n)[:, None]
    to_camera = frames.position[tracks.frame] - tracks.points[tracks.track]
    distance = np.linalg.norm(to_camera, axis=1)
    direction = sum_by_track(tracks.track, to_camera / distance[:, None], n)
    size = frames.size_px[tracks.frame, tracks.keypoint] / frames.focal_px[tracks.frame] * distance
    descriptors = sum_by_track(tracks.track, frames.descriptors[tracks.frame, tracks.keypoint].astype(float), n)
    order = np.lexsort((tracks.track, tracks.frame))
    return LandmarkMap(
        points=tracks.points,
        descriptors=quantize_descriptors(descriptors),
        log_size=(sum_by_track(tracks.track, np.log2(size)[:, None], n) / count)[:, 0].astype(np.float32),
        direction=(direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32),
        seen_point=tracks.track[order].astype(np.int32),
        seen_frame=tracks.frame[order].astype(np.int32),
        rotation=frames.rotation,
        position=frames.position,
    )


def find_rays(frames: MapFrames, frame: np.ndarray, keypoint: np.ndarray) -> np.ndarray:
    """(O, 3) unit directions in the world of keypoints `keypoint` of frames `frame`."""
    local = np.column_stack([frames.points[frame, keypoint], np.ones(len(frame))])
    rays = np.einsum("oij,oj->oi", frames.rotation[frame], local)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
