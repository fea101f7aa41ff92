"""Chooses the frames to reconstruct from: sharp ones, as often as the image moves."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np

__all__ = ["FrameMeasures", "choose_frames", "measure_frames"]

WIDTH = 320
"""Pixels to which frames are shrunk to be measured."""

STEP = 0.03
"""Movement of the image, as a share of its width, for which one frame is chosen."""

STILL = 0.0003
"""A frame that moved less is a repetition of the one before it."""

CORNERS = 200
LOST = 0.5
"""With fewer corners found again than this share, the image counts as wholly another."""


class FrameMeasures(NamedTuple):
    """What frames are chosen by.

    Attributes:
        sharpness: (N,) variance of the Laplacian.
        motion: (N,) median movement of corners since the frame before, as a share of the width, at most 1; 0 for the
            first frame.
    """

    sharpness: np.ndarray
    motion: np.ndarray


def measure_frames(frames: Iterable[np.ndarray]) -> FrameMeasures:
    """Measure frames (H, W) uint8 in order; they may differ in size."""
    sharpness, motion = [], []
    before: np.ndarray | None = None
    for frame in frames:
        height = max(round(frame.shape[0] * WIDTH / frame.shape[1]), 8)
        small = cv2.resize(frame, (WIDTH, height), interpolation=cv2.INTER_AREA)
        sharpness.append(float(cv2.Laplacian(small, cv2.CV_32F).var()))
        motion.append(0.0 if before is None else _measure_motion(before, small))
        before = small
    return FrameMeasures(np.array(sharpness), np.array(motion))


def _measure_motion(before: np.ndarray, after: np.ndarray) -> float:
    """Median movement of corners as a share of the width; 1 if they are not found again."""
    if before.shape != after.shape:
        return 1.0
    corners = cv2.goodFeaturesToTrack(before, CORNERS, 0.01, 8)
    if corners is None:
        return 0.0 if np.array_equal(before, after) else 1.0
    ahead, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, np.zeros_like(corners), winSize=(15, 15))
    back, again, _ = cv2.calcOpticalFlowPyrLK(after, before, ahead, np.zeros_like(corners), winSize=(15, 15))
    kept = (found[:, 0] > 0) & (again[:, 0] > 0) & (np.linalg.norm((back - corners)[:, 0], axis=1) < 1)
    if kept.mean() < LOST:
        return 1.0
    return min(float(np.median(np.linalg.norm((ahead - corners)[kept, 0], axis=1))) / WIDTH, 1.0)


def choose_frames(measures: FrameMeasures, every: int | None = None, step: float = STEP) -> np.ndarray:
    """Numbers of the chosen frames, ascending.

    Frames are cut into stretches in which the image moves by `step`; of each, the sharpest frame is chosen. Where each
    frame moves by more, all are chosen. Repetitions of the frame before are never chosen.

    Args:
        measures: of N frames.
        every: stretches of that many frames instead, whatever moves; repetitions do not count.
        step: movement, as a share of the image's width.
    """
    moved = np.flatnonzero((measures.motion > STILL) | (np.arange(len(measures.motion)) == 0))
    travelled = np.cumsum(measures.motion)[moved]
    stretch = np.arange(len(moved)) // (every or 1)
    if every is None:
        start = 0
        for k in range(len(moved)):
            start = k if travelled[k] - travelled[start] >= step else start
            stretch[k] = start
    stretches = np.split(moved, np.flatnonzero(np.diff(stretch)) + 1)
    return np.array([members[np.argmax(measures.sharpness[members])] for members in stretches], dtype=int)
