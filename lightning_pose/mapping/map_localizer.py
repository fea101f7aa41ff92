"""Locating one image in a landmark map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lightning_pose.geometry.absolute_pose import CameraPose, find_pose_ransac, refine_pose
from lightning_pose.mapping.landmark_map import LandmarkMap

__all__ = ["MapAnswer", "MapLocalizer", "MapQuery"]

VOTE_DISTANCE = 0.6
MATCH_DISTANCE = 0.6
MATCH_RATIO = 0.85
CANDIDATES = 12
MIN_MATCHES = 8
RANSAC_PX = 6.0
GUIDED_PX = 8.0
GUIDED_DISTANCE = 0.7
GUIDED_RATIO = 0.9
SIZE_OCTAVES = 1.0
MIN_COSINE = 0.5
SIGMA_PX = 1.0
INLIER_PX = 3.0
ACCEPT_INLIERS = 20


@dataclass(frozen=True)
class MapQuery:
    """Keypoints of one image, as `MapFrames` has them of many.

    Attributes:
        points: (N, 2) float64, normalised image coordinates.
        size_px: (N,) float32.
        descriptors: (N, D) float32, L2-normalised.
        focal_px: focal length.
        half_view: (2,) half the width and height of the image in normalised image coordinates.
    """

    points: np.ndarray
    size_px: np.ndarray
    descriptors: np.ndarray
    focal_px: float
    half_view: np.ndarray


@dataclass(frozen=True)
class MapAnswer:
    """Where an image was taken.

    Attributes:
        pose: None where refused before a pose was found.
        inliers: guided matches within 3 px.
        visible: points of the map in view.
        reason: why the map refuses, or an empty string where it accepts.
        normal: (6, 6), as of `RefinedPose`.
    """

    pose: CameraPose | None
    inliers: int
    visible: int
    reason: str
    normal: np.ndarray | None = None


class MapLocalizer:
    """A map, prepared for queries.

    Args:
        landmark_map: the map.
    """

    def __init__(self, landmark_map: LandmarkMap) -> None:
        self.map = landmark_map
        self._descriptors = landmark_map.unit_descriptors
        n_frames = len(landmark_map.rotation)
        length = np.bincount(landmark_map.seen_point, minlength=len(landmark_map))
        self._vote = (1 / np.sqrt(np.maximum(length, 1))).astype(np.float32)
        self._points_of_frame = np.bincount(landmark_map.seen_frame, minlength=n_frames)
        self._first = np.concatenate([[0], np.cumsum(self._points_of_frame)])
        order = np.argsort(landmark_map.seen_point, kind="stable")
        self._frames = landmark_map.seen_frame[order]
        self._first_frame = np.concatenate([[0], np.cumsum(length)])
        self._points = landmark_map.points

    def locate(self, query: MapQuery) -> MapAnswer:
        """Candidates, matches, RANSAC, one guided pass, refinement."""
        if len(query.points) < MIN_MATCHES:
            return MapAnswer(None, 0, 0, f"too few features: {len(query.points)}")
        similarity = query.descriptors @ self._descriptors.T
        rows, points = self._match(similarity)
        if len(rows) < MIN_MATCHES:
            return MapAnswer(None, 0, 0, f"too few matches: {len(rows)}")
        found = find_pose_ransac(self._points[points], query.points[rows], RANSAC_PX / query.focal_px)
        if found is None:
            return MapAnswer(None, 0, 0, "weak geometry: no pose agrees with four matches")
        pose, mask = found
        sigma = SIGMA_PX / query.focal_px
        pose = refine_pose(pose, self._points[points[mask]], query.points[rows[mask]], 2 * sigma).pose
        rows, points, visible = self._match_guided(query, similarity, pose)
        if len(rows) < MIN_MATCHES:
            return MapAnswer(pose, len(rows), visible, f"too few guided inliers: {len(rows)}")
        refined = refine_pose(pose, self._points[points], query.points[rows], sigma)
        local = (self._points[points] - refined.pose.position) @ refined.pose.rotation
        error = np.linalg.norm(local[:, :2] / np.maximum(local[:, 2:], 1e-9) - query.points[rows], axis=1)
        inliers = int((error * query.focal_px <= INLIER_PX).sum())
        reason = "" if inliers >= ACCEPT_INLIERS else f"too few guided inliers: {inliers}"
        return MapAnswer(refined.pose, inliers, visible, reason, refined.normal)

    def _match(self, similarity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints and points: mutual matches with what the most likely training frames saw."""
        nearest = similarity.argmax(axis=1)
        sure = similarity[np.arange(len(nearest)), nearest] > 1 - VOTE_DISTANCE**2 / 2
        voted = nearest[sure]
        first, last = self._first_frame[voted], self._first_frame[voted + 1]
        frames = self._frames[_join_ranges(first, last)]
        votes = np.bincount(frames, np.repeat(self._vote[voted], last - first), len(self._points_of_frame))
        score = votes / np.sqrt(self._points_of_frame + 20.0)
        best = np.argsort(-score, kind="stable")[:CANDIDATES]
        points = np.unique(self.map.seen_point[_join_ranges(self._first[best], self._first[best + 1])])
        if len(points) < 2:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        among = similarity[:, points]
        rows = np.arange(len(among))
        best_point = among.argmax(axis=1)
        best_row = among.argmax(axis=0)
        value = among[rows, best_point]
        among[rows, best_point] = -1
        second = among.max(axis=1)
        kept = (best_row[best_point] == rows) & (value > 1 - MATCH_DISTANCE**2 / 2)
        kept &= (1 - value) < MATCH_RATIO**2 * (1 - second)
        return rows[kept], points[best_point[kept]]

    def _match_guided(
        self, query: MapQuery, similarity: np.ndarray, pose: CameraPose
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Keypoints and points: mutual matches near where the pose puts the points; and how many are in view."""
        away = self._points - pose.position
        local = away @ pose.rotation
        distance = np.linalg.norm(away, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = local[:, :2] / local[:, 2:]
            inside = (np.abs(seen) <= query.half_view).all(axis=1) & (local[:, 2] > 0)
        facing = -(away * self.map.direction).sum(axis=1) >= MIN_COSINE * distance
        visible = np.flatnonzero(inside & facing)
        if len(visible) < 2:
            return np.zeros(0, np.int64), np.zeros(0, np.int64), len(visible)
        seen = seen[visible].astype(np.float32)
        log_size = self.map.log_size[visible] - np.log2(distance[visible]).astype(np.float32)
        observed = query.points.astype(np.float32)
        apart = (observed[:, :1] - seen[:, 0]) ** 2 + (observed[:, 1:] - seen[:, 1]) ** 2
        possible = apart <= (GUIDED_PX / query.focal_px) ** 2
        row, column = np.nonzero(possible)
        size = np.log2(query.size_px[row] / query.focal_px)
        value = similarity[row, visible[column]]
        kept = (np.abs(size - log_size[column]) <= SIZE_OCTAVES) & (value > 1 - GUIDED_DISTANCE**2 / 2)
        row, column, value = row[kept], column[kept], value[kept]
        best, second = _rank_within(row, value)
        best_of_point, _ = _rank_within(column, value)
        chosen = best & best_of_point & ((1 - value) < GUIDED_RATIO**2 * (1 - second))
        return row[chosen], visible[column[chosen]], len(visible)


def _join_ranges(first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """The whole numbers from each `first` up to its `last`, one range after the other."""
    length = last - first
    return np.repeat(first - np.cumsum(length) + length, length) + np.arange(length.sum())


def _rank_within(group: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether each value is the largest of its group, and the second largest of its group (-1 for none)."""
    order = np.lexsort((-value, group))
    start = np.diff(group[order], prepend=-1) != 0
    best = np.zeros(len(group), bool)
    best[order[start]] = True
    second_at = np.flatnonzero(start) + 1
    has_second = (second_at < len(group)) & ~np.append(start, True)[np.minimum(second_at, len(group))]
    second = np.full(start.sum(), -1.0)
    second[has_second] = value[order[second_at[has_second]]]
    back = np.empty(len(group))
    back[order] = np.repeat(second, np.diff(np.append(np.flatnonzero(start), len(group))))
    return best, back
