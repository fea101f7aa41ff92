"""LandmarkMap: points of a scene with what they look like, and which training frames saw them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["LandmarkMap", "quantize_descriptors"]

QUANTUM = 127.0
"""Descriptors are kept as int8, scaled to their largest element."""


@dataclass(frozen=True)
class LandmarkMap:
    """P points, seen O times by F training frames.

    Attributes:
        points: (P, 3) float64, relative to the scene's origin, in its unit.
        descriptors: (P, D) int8; `unit_descriptors` gives them at unit length.
        log_size: (P,) float32, mean log2 of the keypoint's diameter, in radians of view, times its distance.
        direction: (P, 3) float32, mean direction from the point to the cameras that saw it, unit length.
        seen_point: (O,) int32, the point of each observation.
        seen_frame: (O,) int32, its frame; observations are sorted by frame, then point.
        rotation: (F, 3, 3) float64, camera-to-world rotation of each training frame, as the map sees it.
        position: (F, 3) float64.
    """

    points: np.ndarray
    descriptors: np.ndarray
    log_size: np.ndarray
    direction: np.ndarray
    seen_point: np.ndarray
    seen_frame: np.ndarray
    rotation: np.ndarray
    position: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    @property
    def unit_descriptors(self) -> np.ndarray:
        """(P, D) float32, L2-normalised."""
        full = self.descriptors.astype(np.float32)
        return full / np.maximum(np.linalg.norm(full, axis=1, keepdims=True), 1e-12)


def quantize_descriptors(descriptors: np.ndarray) -> np.ndarray:
    """(P, D) int8 of (P, D) float32 descriptors: each is scaled to its largest element."""
    largest = np.maximum(np.abs(descriptors).max(axis=1, keepdims=True), 1e-12)
    return np.rint(descriptors / largest * QUANTUM).astype(np.int8)
