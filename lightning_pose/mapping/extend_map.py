"""Adding the frames of another recording to a landmark map, without building it anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.geometry.rolling_shutter import remove_rolling
from lightning_pose.geometry.triangulation import reprojection_errors
from lightning_pose.mapping.build_map import (
    MappedFrames,
    PointSums,
    find_points,
    sum_observations,
    summarize_tracks,
)
from lightning_pose.mapping.calibration import locate_frames
from lightning_pose.mapping.frames import MapFrames, find_turn_rates
from lightning_pose.mapping.map_localizer import INLIER_PX, MapLocalizer
from lightning_pose.mapping.point_map import PointMap, quantize_descriptors
from lightning_pose.mapping.query_matching import QueryMatcher
from lightning_pose.mapping.threads import map_in_threads
from lightning_pose.mapping.track_points import Tracks

__all__ = ["extend_map"]


def extend_map(old: PointMap, frames: MapFrames) -> PointMap:
    """A map with more frames, whose old points and frames stay where they are.

    The frames are located in the map; one that is refused is put where the given poses of the map's own frames say.
    Keypoints that show old points are further observations of these: they change their descriptors. The others are
    matched with each other and become points as in a new map. The time grows with the new frames alone.

    Args:
        old: the map.
        frames: of the other recording, with the poses that its dataset gives, in the world of the map.
    """
    seen = _place_frames(old, frames)
    tracks = find_points(seen, old.measure_depth())
    point_of = _match_old_points(old, seen)
    owner = _find_owners(point_of[tracks.frame, tracks.keypoint], tracks)
    new = tracks.select(owner[tracks.track] < 0)
    shown = _join_old_observations(old, seen, point_of, tracks, owner)
    added = summarize_tracks(MappedFrames(frames, seen, new))
    known = _average_old_points(old, sum_observations(seen, shown, len(old)))
    frame = np.concatenate([shown.frame, new.frame])
    point = np.concatenate([shown.track, new.track + len(old)])
    order = np.lexsort((point, frame))
    return PointMap(
        points=np.concatenate([old.points, added.points]),
        descriptors=np.concatenate([known.descriptors, added.descriptors]),
        log_size=np.concatenate([known.log_size, added.log_size]),
        direction=np.concatenate([known.direction, added.direction]),
        seen_point=np.concatenate([old.seen_point, point[order].astype(np.int32)]),
        seen_count=np.concatenate([old.seen_count, np.bincount(frame, minlength=len(seen)).astype(np.int32)]),
        rotation=np.concatenate([old.rotation, seen.rotation]),
        position=np.concatenate([old.position, seen.position]),
        given_rotation=np.concatenate([old.given_rotation, frames.rotation]),
        given_position=np.concatenate([old.given_position, frames.position]),
        camera=old.camera,
    )


def _place_frames(old: PointMap, frames: MapFrames) -> MapFrames:
    """The frames with the poses and keypoints of the map's own cameras."""
    localizer = MapLocalizer(old)
    poses = [
        answer.pose_in_map if answer.accepted else localizer.given_poses.carry_forward(CameraPose(rotation, position))
        for answer, rotation, position in zip(
            locate_frames(localizer, frames), frames.rotation, frames.position, strict=True
        )
    ]
    rotation, position = (np.array(each) for each in zip(*poses, strict=True))
    readout = float(old.camera[4]) if len(old.camera) > 4 else 0.0
    still = remove_rolling(
        old.camera_correction.remove(frames.points), (readout * find_turn_rates(frames.rotation))[:, None]
    )
    return replace(frames.with_poses(rotation, position), points=np.where(frames.real[:, :, None], still, 0.0))


def _match_old_points(old: PointMap, seen: MapFrames) -> np.ndarray:
    """(F, N) the old point that each keypoint shows; -1 for none."""
    matcher, point_of = QueryMatcher(old), np.full(seen.points.shape[:2], -1)

    def match(i: int) -> None:
        query, pose = seen.query(i), CameraPose(seen.rotation[i], seen.position[i])
        row, point, _ = matcher.match_guided(query, query.points, pose)
        away = old.points[point] - pose.position
        count = len(row)
        turned = np.broadcast_to(pose.rotation, (count, 3, 3))
        error = reprojection_errors(away, np.zeros((count, 3)), turned, query.points[row])
        near = np.linalg.norm(error, axis=1) * query.focal_px <= INLIER_PX
        point_of[i, row[near]] = point[near]

    map_in_threads(match, range(len(seen)))
    return point_of


def _find_owners(point: np.ndarray, tracks: Tracks) -> np.ndarray:
    """(T,) the old point that most keypoints of each track show; -1 where none shows one.

    Args:
        point: (O,) that of each observation, -1 for none.
        tracks: of the new frames.
    """
    owner = np.full(len(tracks.points), -1)
    shows = point >= 0
    pairs, count = np.unique(np.stack([tracks.track[shows], point[shows]]), axis=1, return_counts=True)
    order = np.argsort(count, kind="stable")  # the most frequent is written last
    owner[pairs[0][order]] = pairs[1][order]
    return owner


def _join_old_observations(
    old: PointMap, seen: MapFrames, point_of: np.ndarray, tracks: Tracks, owner: np.ndarray
) -> Tracks:
    """Observations of old points by new frames, also of tracks that a point owns; one of a point in a frame."""
    frame, keypoint = np.nonzero(point_of >= 0)
    owned = owner[tracks.track] >= 0
    point = np.concatenate([point_of[frame, keypoint], owner[tracks.track[owned]]])
    frame = np.concatenate([frame, tracks.frame[owned]])
    keypoint = np.concatenate([keypoint, tracks.keypoint[owned]])
    error = reprojection_errors(
        old.points[point], seen.position[frame], seen.rotation[frame], seen.points[frame, keypoint]
    )
    near = np.linalg.norm(error, axis=1) * seen.focal_px[frame] <= INLIER_PX
    frame, keypoint, point = frame[near], keypoint[near], point[near]
    _, first = np.unique(point * len(seen) + frame, return_index=True)
    return Tracks(point[first], frame[first], keypoint[first], old.points, tracks.fewest)


def _average_old_points(old: PointMap, new: PointSums) -> PointMap:
    """The old map, whose points' descriptors, sizes and directions are means over old and new observations."""
    count = np.bincount(old.seen_point, minlength=len(old)).astype(float)[:, None]
    direction = old.direction * count + new.direction
    return replace(
        old,
        descriptors=quantize_descriptors(old.unit_descriptors * count + new.descriptors),
        log_size=((old.log_size[:, None] * count + new.log_size) / (count + new.count))[:, 0].astype(np.float32),
        direction=(direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32),
    )
