"""Matching an image's keypoints to the points of a map."""

from __future__ import annotations

import numpy as np

from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.mapping.frames import MapQuery, find_distance_scale
from lightning_pose.mapping.point_map import PointMap

__all__ = ["QueryMatcher"]

CANDIDATES = 12
"""Training frames whose points an image is matched to."""

VOTE_DISTANCE = 0.6
"""Largest distance of descriptors for a vote."""

FRAME_PRIOR = 20.0
"""Points added to a frame's own when its votes are divided by the root of their number."""

MATCH_DISTANCE = 0.6
MATCH_RATIO = 0.85

GUIDED_PX = 8.0
"""How far a keypoint may lie from where a good pose puts the point."""

GUIDED_DISTANCE = 0.7
GUIDED_RATIO = 0.9
SIZE_OCTAVES = 1.0
"""How many octaves a keypoint may be larger or smaller than the point should appear."""

MIN_COSINE = 0.5
"""Of the angle between a view of a point and the mean of those it was seen under: 60 degrees."""

NONE = np.zeros(0, np.int64)


class QueryMatcher:
    """The part of a map that matching reads, prepared once.

    Args:
        point_map: the map.
    """

    def __init__(self, point_map: PointMap) -> None:
        self.map = point_map
        self._descriptors = np.ascontiguousarray(point_map.unit_descriptors.T)
        length = np.bincount(point_map.seen_point, minlength=len(point_map))
        self._vote = 1 / np.sqrt(np.maximum(length, 1))
        self._points_of_frame = point_map.seen_count.astype(np.int64)
        self._first_of_frame = np.concatenate([[0], np.cumsum(self._points_of_frame)])
        self._frames = point_map.seen_frame[np.argsort(point_map.seen_point, kind="stable")]
        self._first_of_point = np.concatenate([[0], np.cumsum(length)])

    def compare(self, descriptors: np.ndarray) -> np.ndarray:
        """(N, P) cosines between an image's descriptors (N, D) and the map's, as they would be of SURF."""
        similarity, scale = descriptors @ self._descriptors, find_distance_scale(descriptors)
        return similarity if scale == 1 else 1 - (1 - similarity) / scale**2

    def match_candidates(self, similarity: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        """Mutual matches with what the most likely training frames saw.

        Each keypoint's nearest point votes for the frames that saw it.

        Args:
            similarity: (N, P), from `compare`.

        Returns:
            the most likely frame (-1 for none), and the keypoints (K,) and points (K,) of the matches.
        """
        if 0 in similarity.shape:
            return -1, NONE, NONE
        nearest = similarity.argmax(axis=1)
        rows = np.arange(len(nearest))
        voted = nearest[similarity[rows, nearest] > 1 - VOTE_DISTANCE**2 / 2]
        first, last = self._first_of_point[voted], self._first_of_point[voted + 1]
        votes = np.bincount(
            self._frames[_join_ranges(first, last)], np.repeat(self._vote[voted], last - first), len(self.map.position)
        )
        score = votes / np.sqrt(self._points_of_frame + FRAME_PRIOR)
        best = np.argsort(-score, kind="stable")[:CANDIDATES]
        points = np.unique(
            self.map.seen_point[_join_ranges(self._first_of_frame[best], self._first_of_frame[best + 1])]
        )
        if len(points) < 2:
            return int(best[0]), NONE, NONE
        among = similarity[:, points]
        best_point = among.argmax(axis=1)
        mutual = among.argmax(axis=0)[best_point] == rows
        value = among[rows, best_point]
        among[rows, best_point] = -1
        kept = mutual & (value > 1 - MATCH_DISTANCE**2 / 2) & (1 - value < MATCH_RATIO**2 * (1 - among.max(axis=1)))
        return int(best[0]), rows[kept], points[best_point[kept]]

    def match_guided(
        self,
        query: MapQuery,
        points: np.ndarray,
        similarity: np.ndarray,
        pose: CameraPose,
        radius_px: float = GUIDED_PX,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mutual matches near where a pose puts the points that it should show.

        Args:
            query: the image.
            points: (N, 2), its keypoints with the camera's error removed.
            similarity: (N, P), from `compare`.
            pose: where the camera is thought to be.
            radius_px: how far a keypoint may lie from its point.

        Returns:
            keypoints (K,), points (K,), and where the points that should be in view appear, (V, 2) normalised image
            coordinates.
        """
        away = self.map.points - pose.position
        local = away @ pose.rotation
        distance = np.linalg.norm(away, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = local[:, :2] / local[:, 2:]
            inside = (np.abs(seen) <= query.half_view).all(axis=1) & (local[:, 2] > 0)
        visible = np.flatnonzero(inside & (-(away * self.map.direction).sum(axis=1) >= MIN_COSINE * distance))
        seen = seen[visible]
        squared = (points[:, None, 0] - seen[None, :, 0]) ** 2 + (points[:, None, 1] - seen[None, :, 1]) ** 2
        row, column = np.nonzero(squared <= (radius_px / query.focal_px) ** 2)
        point = visible[column]
        octaves = np.log2(query.size_px[row] / query.focal_px) - (self.map.log_size[point] - np.log2(distance[point]))
        value = similarity[row, point]
        kept = (np.abs(octaves) <= SIZE_OCTAVES) & (value > 1 - GUIDED_DISTANCE**2 / 2)
        row, point, value = row[kept], point[kept], value[kept]
        best, second = _rank_within(row, value)
        best_of_point, _ = _rank_within(point, value)
        chosen = best & best_of_point & (1 - value < GUIDED_RATIO**2 * (1 - second))
        return row[chosen], point[chosen], seen


def _join_ranges(first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """The whole numbers from each `first` up to its `last`, one range after the other."""
    length = last - first
    return np.repeat(first - np.cumsum(length) + length, length) + np.arange(length.sum())


def _rank_within(group: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether each value is the largest of its group, and the second largest of its group (-1 for none)."""
    order = np.lexsort((-value, group))
    first = np.diff(group[order], prepend=-1) != 0
    best = np.zeros(len(group), bool)
    best[order[first]] = True
    starts = np.flatnonzero(first)
    ends = np.append(starts[1:], len(group))
    second = np.full(len(starts), -1.0)
    several = ends - starts > 1
    second[several] = value[order[starts[several] + 1]]
    of_each = np.empty(len(group))
    of_each[order] = np.repeat(second, ends - starts)
    return best, of_each
