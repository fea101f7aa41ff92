"""Matching an image's keypoints to the points of a map."""

from __future__ import annotations

import numpy as np

from lightning_pose.geometry.absolute_pose import CameraPose
from lightning_pose.mapping.frames import MapQuery, find_distance_scale
from lightning_pose.mapping.point_map import PointMap
from lightning_pose.mapping.threads import multiply
from lightning_pose.mapping.vote_index import VoteIndex

__all__ = ["QueryMatcher"]

VOTE_DISTANCE = 0.6
"""Largest distance of descriptors for a vote."""

FRAME_PRIOR = 20.0
"""Points added to a frame's own when its votes are divided by the root of their number."""

MATCH_DISTANCE = 0.6
MATCH_RATIO = 0.85

GUIDED_PX = 8.0
"""How far a keypoint may lie from where the pose puts the point."""

GUIDED_DISTANCE = 0.7
GUIDED_RATIO = 0.9
SIZE_OCTAVES = 1.0
"""How many octaves a keypoint may be larger or smaller than the point should appear."""

MOST_NEAR = 300
"""Training frames near a pose whose points it may show, where a map has more than `MOST_FRAMES`."""

MOST_FRAMES = 1000
"""Up to so many training frames, all points may be in view."""

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
        self._descriptors = point_map.unit_descriptors
        self._depth = point_map.measure_depth()
        self._index = VoteIndex(self._descriptors)
        length = np.bincount(point_map.seen_point, minlength=len(point_map))
        self._vote = 1 / np.sqrt(np.maximum(length, 1))
        self._points_of_frame = point_map.seen_count.astype(np.int64)
        self._first_of_frame = np.concatenate([[0], np.cumsum(self._points_of_frame)])
        self._frames = point_map.seen_frame[np.argsort(point_map.seen_point, kind="stable")]
        self._first_of_point = np.concatenate([[0], np.cumsum(length)])

    def rank_frames(self, descriptors: np.ndarray) -> np.ndarray:
        """Numbers of the training frames, the most likely first; each keypoint's nearest point votes for its frames.

        Args:
            descriptors: (N, D), of an image.

        Returns:
            (F,) int64; (0,) without descriptors or points.
        """
        if not len(descriptors) or not len(self._descriptors):
            return NONE
        nearest = self._index.find_nearest(descriptors)
        voted = nearest[self._compare(descriptors, np.arange(len(descriptors)), nearest) > 1 - VOTE_DISTANCE**2 / 2]
        first, last = self._first_of_point[voted], self._first_of_point[voted + 1]
        votes = np.bincount(
            self._frames[_join_ranges(first, last)], np.repeat(self._vote[voted], last - first), len(self.map.position)
        )
        return np.argsort(-votes / np.sqrt(self._points_of_frame + FRAME_PRIOR), kind="stable")

    def match_frames(self, descriptors: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mutual matches with what any of some training frames saw.

        Args:
            descriptors: (N, D), of an image.
            frames: (K,) numbers of training frames.

        Returns:
            the keypoints (M,) and points (M,) of the matches.
        """
        points = self._list_seen(frames)
        if len(points) < 2:
            return NONE, NONE
        rows = np.arange(len(descriptors))
        among = multiply(descriptors, self._descriptors[points].T)
        best_point = among.argmax(axis=1)
        value = among[rows, best_point]
        mutual = among.max(axis=0)[best_point] == value
        among[rows, best_point] = -1
        away, second = 1 - value, 1 - among.max(axis=1)
        near = away < MATCH_DISTANCE**2 / 2 * find_distance_scale(descriptors) ** 2
        kept = mutual & near & (away < MATCH_RATIO**2 * second)
        return rows[kept], points[best_point[kept]]

    def match_guided(
        self, query: MapQuery, points: np.ndarray, pose: CameraPose, radius_px: float = GUIDED_PX
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mutual matches near where a pose puts the points that it should show.

        Args:
            query: the image.
            points: (N, 2), its keypoints with the camera's error removed.
            pose: where the camera is thought to be.
            radius_px: how far a keypoint may lie from its point.

        Returns:
            keypoints (K,), points (K,), and where the points that should be in view appear, (V, 2) normalised image
            coordinates.
        """
        near = self._list_near(pose)
        away = self.map.points[near] - pose.position
        local = away @ pose.rotation
        distance = np.linalg.norm(away, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = local[:, :2] / local[:, 2:]
            inside = (np.abs(seen) <= query.half_view).all(axis=1) & (local[:, 2] > 0)
        visible = np.flatnonzero(inside & (-(away * self.map.direction[near]).sum(axis=1) >= MIN_COSINE * distance))
        seen = seen[visible]
        row, column = find_near_places(points, seen, radius_px / query.focal_px)
        point = near[visible[column]]
        expected = self.map.log_size[point] - np.log2(distance[visible[column]])
        octaves = np.log2(query.size_px[row] / query.focal_px) - expected
        alike = np.abs(octaves) <= SIZE_OCTAVES
        row, point = row[alike], point[alike]
        value = self._compare(query.descriptors, row, point)
        kept = value > 1 - GUIDED_DISTANCE**2 / 2
        row, point, value = row[kept], point[kept], value[kept]
        best, second = _rank_within(row, value)
        best_of_point, _ = _rank_within(point, value)
        chosen = best & best_of_point & (1 - value < GUIDED_RATIO**2 * (1 - second))
        return row[chosen], point[chosen], seen

    def _list_seen(self, frames: np.ndarray) -> np.ndarray:
        """Numbers of the points that any of some training frames saw, in ascending order."""
        seen = np.zeros(len(self.map), bool)
        seen[self.map.seen_point[_join_ranges(self._first_of_frame[frames], self._first_of_frame[frames + 1])]] = True
        return np.flatnonzero(seen)

    def _list_near(self, pose: CameraPose) -> np.ndarray:
        """Numbers of the points that a camera may see: those of the training frames nearest to it, or all.

        A map of many rooms has many points behind walls, which would cost time and match by chance.
        """
        frames = self.map.position
        if len(frames) <= MOST_FRAMES:
            return np.arange(len(self.map))
        away = np.linalg.norm(frames - pose.position, axis=1) / self._depth
        turned = 1 - self.map.rotation[:, :, 2] @ pose.rotation[:, 2]
        return self._list_seen(np.argpartition(away + turned, MOST_NEAR)[:MOST_NEAR])

    def _compare(self, descriptors: np.ndarray, row: np.ndarray, point: np.ndarray) -> np.ndarray:
        """(K,) cosines between an image's descriptors and those of points, as they would be of SURF."""
        similarity = np.einsum("kd,kd->k", descriptors[row], self._descriptors[point])
        scale = find_distance_scale(descriptors)
        return similarity if scale == 1 else 1 - (1 - similarity) / scale**2


def find_near_places(points: np.ndarray, places: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns (K,) of points (N, 2) and places (V, 2) within a radius of each other, in ascending order.

    The places are sorted into square cells, line by line, so that the three cells of a line beside a point are one
    range.
    """
    if not len(points) or not len(places):
        return NONE, NONE
    low = places.min(axis=0) - radius
    cell = ((places - low) / radius).astype(np.int64)
    width, height = cell.max(axis=0) + 2
    number = cell[:, 1] * width + cell[:, 0]
    order = np.argsort(number, kind="stable")
    number = number[order]
    x, y = np.clip((points - low) / radius, 0, [width - 1, height - 1]).astype(np.int64).T
    middle = (y * width + x)[:, None] + np.array([-width, 0, width])
    first, last = np.searchsorted(number, middle - 1), np.searchsorted(number, middle + 1, side="right")
    column = order[_join_ranges(first.ravel(), last.ravel())]
    row = np.repeat(np.arange(len(points)), (last - first).sum(axis=1))
    near = ((points[row] - places[column]) ** 2).sum(axis=1) <= radius**2
    return np.divmod(np.sort(row[near] * len(places) + column[near]), len(places))


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
