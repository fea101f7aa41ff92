"""Building a landmark map from posed frames with keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.geometry.rolling_shutter import remove_rolling
from lightning_pose.geometry.triangulation import sum_by_track
from lightning_pose.mapping.bundle_adjustment import Adjustment, adjust_bundle
from lightning_pose.mapping.camera_correction import CameraCorrection
from lightning_pose.mapping.frames import MapFrames, find_turn_rates
from lightning_pose.mapping.pairs import choose_pairs
from lightning_pose.mapping.point_map import PointMap, quantize_descriptors
from lightning_pose.mapping.scene_depth import measure_depth
from lightning_pose.mapping.track_points import Tracks, find_tracks, triangulate_tracks

__all__ = [
    "MappedFrames",
    "PointSums",
    "add_frames",
    "adjust_mapped",
    "build_point_map",
    "find_points",
    "map_frames",
    "roll_mapped",
    "sum_observations",
    "summarize_tracks",
]

MIN_OBSERVATIONS = 4
"""Frames that must see a point. 5 accepts fewer training frames left out; 3 makes a larger map of no use."""

MIN_OBSERVATIONS_OF_FEW = 3
"""The same where frames overlap with few others."""


@dataclass(frozen=True)
class MappedFrames:
    """Frames, tracks and camera of a map, from which a `PointMap` or another map without some frames is made.

    Attributes:
        given: the frames with the poses that the dataset gives.
        seen: the same with the poses and keypoints of the map's own cameras.
        tracks: the map's points and their observations.
        state: what bundle adjustment found, from which another goes on; None before the first.
    """

    given: MapFrames
    seen: MapFrames
    tracks: Tracks
    state: Adjustment | None = None

    @property
    def depth(self) -> float:
        """Median distance of the points from the frames that see them; 1 without points."""
        if not len(self.tracks.points):
            return 1.0
        away = self.tracks.points[self.tracks.track] - self.seen.position[self.tracks.frame]
        return float(np.median(np.linalg.norm(away, axis=1)))

    @property
    def camera(self) -> CameraCorrection:
        """What was wrong with the assumed camera."""
        return CameraCorrection() if self.state is None else self.state.camera

    @property
    def readout(self) -> float:
        """Of a rolling shutter, as `Adjustment` has it."""
        return 0.0 if self.state is None else self.state.readout


class PointSums(NamedTuple):
    """Sums over the observations of each point.

    Attributes:
        count: (P, 1) how many there are.
        direction: (P, 3), of unit directions from the point to the cameras.
        log_size: (P, 1), of log2 of the keypoint's diameter as an angle times its distance.
        descriptors: (P, D).
    """

    count: np.ndarray
    direction: np.ndarray
    log_size: np.ndarray
    descriptors: np.ndarray


def build_point_map(frames: MapFrames, adjust: bool = False) -> PointMap:
    """The map of posed frames, by `map_frames`."""
    return summarize_tracks(map_frames(frames, adjust))


def map_frames(frames: MapFrames, adjust: bool) -> MappedFrames:
    """Pairs, guided matches, depth vote, tracks, triangulation, bundle adjustment.

    Args:
        frames: with the poses that the dataset gives.
        adjust: move poses, points and camera until they agree with the images, twice: poses that are better find
            more matches. Without it, the given poses are taken as they are.
    """
    mapped = MappedFrames(frames, frames, find_points(frames, measure_depth(frames)))
    return adjust_mapped(mapped, rounds=2) if adjust else mapped


def adjust_mapped(mapped: MappedFrames, rounds: int) -> MappedFrames:
    """The same frames after rounds of bundle adjustment, with new tracks between; one is enough for `add_frames`."""
    given, seen, tracks = mapped.given, mapped.seen, mapped.tracks
    state = Adjustment(given.rotation, given.position, tracks.points)
    for again in range(rounds):
        if again:
            tracks = find_points(seen, mapped.depth)
        state, seen, tracks = _adjust_once(state, given, tracks)
    return MappedFrames(given, seen, triangulate_tracks(seen, tracks), state)


def roll_mapped(mapped: MappedFrames) -> MappedFrames:
    """The same frames after one more bundle adjustment, for a rolling shutter; the tracks are the same.

    Raises:
        ValueError: `mapped` was not adjusted.
    """
    if mapped.state is None:
        raise ValueError("the shutter is found after bundle adjustment")
    state, seen, tracks = _adjust_once(replace(mapped.state, rolling=True), mapped.given, mapped.tracks)
    return MappedFrames(mapped.given, seen, triangulate_tracks(seen, tracks), state)


def add_frames(mapped: MappedFrames, given: MapFrames, rows: np.ndarray, others: Sequence[CameraPose]) -> MappedFrames:
    """A map of more frames, whose old ones start where bundle adjustment has moved them: one round instead of two.

    Args:
        mapped: after bundle adjustment.
        given: the frames of `mapped`, and others.
        rows: (F,) int64, where in `given` the frames of `mapped` are.
        others: where the other frames are in the map, in the order of `given`.

    Raises:
        ValueError: `mapped` was not adjusted.
    """
    old = mapped.state
    if old is None:
        raise ValueError("frames are added to maps after bundle adjustment")
    rotation, position = given.rotation.copy(), given.position.copy()
    rotation[rows], position[rows] = old.rotation, old.position
    new = np.setdiff1d(np.arange(len(given)), rows)
    for row, pose in zip(new, others, strict=True):
        rotation[row] = pose.rotation @ old.offset_rotation.T
        position[row] = pose.position - rotation[row] @ old.offset_position
    start = replace(old, rotation=rotation, position=position)
    seen = _move_frames(start, given)
    tracks = find_points(seen, mapped.depth)
    state, seen, tracks = _adjust_once(start, given, tracks)
    return MappedFrames(given, seen, triangulate_tracks(seen, tracks), state)


def _adjust_once(state: Adjustment, given: MapFrames, tracks: Tracks) -> tuple[Adjustment, MapFrames, Tracks]:
    """What bundle adjustment finds, and the frames and tracks as it moves them."""
    state = adjust_bundle(replace(state, points=tracks.points), given, tracks.track, tracks.frame, tracks.keypoint)
    return state, _move_frames(state, given), replace(tracks, points=state.points)


def _move_frames(state: Adjustment, given: MapFrames) -> MapFrames:
    """The frames with the poses and keypoints of the map's own cameras."""
    rolled = state.camera.remove(given.points)
    still = remove_rolling(rolled, (state.readout * find_turn_rates(given.rotation))[:, None])
    points = np.where(given.real[:, :, None], still, 0.0)
    return replace(given.with_poses(*state.camera_poses), points=points)


def find_points(frames: MapFrames, depth: float) -> Tracks:
    """Points of frames, from new matches; `depth` is a typical distance of what the frames see."""
    pairs, few = choose_pairs(frames, depth)
    fewest = MIN_OBSERVATIONS_OF_FEW if few else MIN_OBSERVATIONS
    return triangulate_tracks(frames, find_tracks(frames, pairs, fewest))


def summarize_tracks(mapped: MappedFrames) -> PointMap:
    """What a map keeps of its frames and tracks."""
    given, frames, tracks, camera = mapped.given, mapped.seen, mapped.tracks, mapped.camera
    sums = sum_observations(frames, tracks, len(tracks.points))
    order = np.lexsort((tracks.track, tracks.frame))
    return PointMap(
        points=tracks.points,
        descriptors=quantize_descriptors(sums.descriptors),
        log_size=(sums.log_size / sums.count)[:, 0].astype(np.float32),
        direction=(sums.direction / np.linalg.norm(sums.direction, axis=1, keepdims=True)).astype(np.float32),
        seen_point=tracks.track[order].astype(np.int32),
        seen_count=np.bincount(tracks.frame, minlength=len(frames)).astype(np.int32),
        rotation=frames.rotation,
        position=frames.position,
        given_rotation=given.rotation,
        given_position=given.position,
        camera=np.array([camera.scale, *camera.centre, camera.k1, mapped.readout]),
    )


def sum_observations(frames: MapFrames, tracks: Tracks, n_points: int) -> PointSums:
    """What the observations of each point add up to; `tracks.track` may leave points out."""
    count = np.bincount(tracks.track, minlength=n_points)[:, None]
    to_camera = frames.position[tracks.frame] - tracks.points[tracks.track]
    distance = np.linalg.norm(to_camera, axis=1)
    size = frames.size_px[tracks.frame, tracks.keypoint] / frames.focal_px[tracks.frame] * distance
    descriptors = frames.descriptors[tracks.frame, tracks.keypoint].astype(float)
    return PointSums(
        count,
        sum_by_track(tracks.track, to_camera / distance[:, None], n_points),
        sum_by_track(tracks.track, np.log2(size)[:, None], n_points),
        sum_by_track(tracks.track, descriptors, n_points),
    )
