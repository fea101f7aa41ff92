"""VoteIndex: which point of a map looks most like each keypoint, found in cells where there are many points."""

from __future__ import annotations

import numpy as np

from lightning_pose.mapping.threads import multiply

__all__ = ["VoteIndex"]

VOTE_COLUMNS = 24
"""Dimensions in which the nearest point is found: a third of the time of all 64, and votes as well."""

VOTE_ROWS = 50
"""Keypoints that are compared at once: as many as fit a processor's cache."""

MOST_VOTED = 20_000
"""Up to so many points, all are compared with each keypoint."""

VOTE_CELLS = 64
"""Cells into which more points are sorted, each around a centre."""

VOTE_LOOKED_INTO = 4
"""Cells of which the points are compared with a keypoint."""

VOTE_SAMPLE, VOTE_ROUNDS = 50, 4
"""Points for each cell, and rounds of k-means, to find the centres (Lloyd, 1982)."""


class VoteIndex:
    """The points of a map by their descriptors along the axes on which these are longest.

    Args:
        descriptors: (P, D) float32, unit rows.
        most_voted: with more points, an inverted index finds the nearest of most keypoints, and a near one of others.
    """

    def __init__(self, descriptors: np.ndarray, most_voted: int = MOST_VOTED) -> None:
        self._axes = find_main_axes(descriptors, VOTE_COLUMNS)
        points = multiply(descriptors, self._axes)
        self._order: np.ndarray | None = None
        if len(points) > most_voted:
            self._centres = _find_centres(points[:: max(1, len(points) // (VOTE_CELLS * VOTE_SAMPLE))])
            cell = np.concatenate(
                [_find_cells(points[i : i + 4096], self._centres, 1)[:, 0] for i in range(0, len(points), 4096)]
            )
            self._order = np.argsort(cell, kind="stable")
            self._first = np.searchsorted(cell[self._order], np.arange(VOTE_CELLS + 1))
            points = points[self._order]
        self._points = np.ascontiguousarray(points.T)

    def find_nearest(self, descriptors: np.ndarray) -> np.ndarray:
        """(N,) int64, the nearest point of each of (N, D) descriptors; there is one point at least."""
        few = multiply(descriptors, self._axes)
        if self._order is None:
            parts = [few[first : first + VOTE_ROWS] for first in range(0, len(few), VOTE_ROWS)]
            return np.concatenate([multiply(part, self._points).argmax(axis=1) for part in parts])
        cells = _find_cells(few, self._centres, VOTE_LOOKED_INTO).ravel()
        by_cell = np.argsort(cells, kind="stable")
        keypoint = by_cell // VOTE_LOOKED_INTO
        ends = np.searchsorted(cells[by_cell], np.arange(VOTE_CELLS + 1))
        nearest, most = np.zeros(len(few), np.int64), np.full(len(few), -np.inf, np.float32)
        for cell in range(VOTE_CELLS):
            rows, first, last = keypoint[ends[cell] : ends[cell + 1]], self._first[cell], self._first[cell + 1]
            if len(rows) and last > first:
                alike = multiply(few[rows], self._points[:, first:last])
                best = alike.argmax(axis=1)
                value = alike[np.arange(len(rows)), best]
                better = value > most[rows]
                nearest[rows[better]], most[rows[better]] = best[better] + first, value[better]
        return self._order[nearest]


def find_main_axes(descriptors: np.ndarray, count: int) -> np.ndarray:
    """(D, count or D) float32, the axes along which (P, D) descriptors are longest, in all."""
    _, axes = np.linalg.eigh(multiply(descriptors.T, descriptors).astype(np.float64))
    return np.ascontiguousarray(axes[:, ::-1][:, :count], dtype=np.float32)


def _find_centres(sample: np.ndarray) -> np.ndarray:
    """(VOTE_CELLS, D) centres of a sample (S, D) of the points, S at least VOTE_CELLS."""
    centres = sample[np.linspace(0, len(sample) - 1, VOTE_CELLS).astype(int)]
    for _ in range(VOTE_ROUNDS):
        cell = _find_cells(sample, centres, 1)[:, 0]
        count = np.bincount(cell, minlength=VOTE_CELLS)
        total = np.stack([np.bincount(cell, column, VOTE_CELLS) for column in sample.T], axis=1)
        centres = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], centres).astype(np.float32)
    return centres


def _find_cells(points: np.ndarray, centres: np.ndarray, count: int) -> np.ndarray:
    """(N, count) cells whose centres are nearest to each of N points, in no particular order."""
    near = multiply(points, np.ascontiguousarray(centres.T)) - (centres**2).sum(axis=1) / 2
    return np.argpartition(-near, count - 1, axis=1)[:, :count]
