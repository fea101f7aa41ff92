"""MapFrames: posed frames with keypoints, as all stages of map building read them; MapQuery: one image, no pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

__all__ = ["MapFrames", "MapQuery", "find_distance_scale", "find_turn_rates"]

BINARY_SCALE = 2.0
"""Distance of two binary descriptors of one point by that of two SURF descriptors, for which thresholds are chosen."""

MOST_TURN = 0.15
"""Radians by which successive frames of a video may turn; 9 degrees."""


def find_turn_rates(rotation: np.ndarray) -> np.ndarray:
    """(F, 3) by how much each camera turns in its own axes from one frame to the next, radians.

    Frames that are far from their neighbours are no successive frames of a video, and have zeros.

    Args:
        rotation: (F, 3, 3), camera-to-world, frame after frame.
    """
    turn = Rotation.from_matrix(np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:]).as_rotvec()
    near = np.linalg.norm(turn, axis=1, keepdims=True) <= MOST_TURN
    sides = np.pad(np.where(near, turn, 0.0), ((1, 1), (0, 0)))
    count = np.pad(near.astype(float), ((1, 1), (0, 0)))
    return (sides[:-1] + sides[1:]) / np.maximum(count[:-1] + count[1:], 1)


def find_distance_scale(descriptors: np.ndarray) -> float:
    """By how much descriptors of one point differ more than those of SURF: binary ones have elements of one size.

    Args:
        descriptors: (N, D), unit rows, or rows of zeros.
    """
    first = np.abs(descriptors[:1])
    binary = len(first) > 0 and first.max() > 0 and first.min() > 0.99 * first.max()
    return BINARY_SCALE if binary else 1.0


@dataclass(frozen=True)
class MapQuery:
    """Keypoints of one image, as `MapFrames` has them of many.

    Attributes:
        points: (N, 2) float64, normalised image coordinates.
        size_px: (N,) float32.
        descriptors: (N, D) float32, L2-normalised.
        focal_px: focal length.
        half_view: (2,), half the width and height of the image in normalised image coordinates.
    """

    points: np.ndarray
    size_px: np.ndarray
    descriptors: np.ndarray
    focal_px: float
    half_view: np.ndarray


@dataclass(frozen=True)
class MapFrames:
    """F posed frames with up to N keypoints each, strongest first.

    Keypoints are normalised image coordinates: (pixel - principal point) / focal length, distortion removed. So no
    stage depends on a camera model; `focal_px` turns thresholds in pixels into normalised units.

    Attributes:
        points: (F, N, 2) float64, normalised image coordinates; zeros past `count`.
        size_px: (F, N) float32, diameters of the keypoints; zeros past `count`.
        descriptors: (F, N, D) float32, L2-normalised; zeros past `count`.
        count: (F,) int64, how many of the N keypoints are real.
        focal_px: (F,) float64.
        half_view: (F, 2) float64, half the width and height of the image in normalised image coordinates.
        rotation: (F, 3, 3) float64, camera-to-world.
        position: (F, 3) float64, camera centres, in the scene's unit relative to its origin.
    """

    points: np.ndarray
    size_px: np.ndarray
    descriptors: np.ndarray
    count: np.ndarray
    focal_px: np.ndarray
    half_view: np.ndarray
    rotation: np.ndarray
    position: np.ndarray

    def __len__(self) -> int:
        return len(self.count)

    def select(self, frames: np.ndarray) -> MapFrames:
        """The frames of these numbers."""
        return MapFrames(**{name: value[frames] for name, value in vars(self).items()})

    def with_poses(self, rotation: np.ndarray, position: np.ndarray) -> MapFrames:
        """The same frames with other poses."""
        return replace(self, rotation=rotation, position=position)

    def query(self, frame: int) -> MapQuery:
        """One of the frames, without its pose."""
        n = self.count[frame]
        return MapQuery(
            self.points[frame, :n],
            self.size_px[frame, :n],
            self.descriptors[frame, :n],
            float(self.focal_px[frame]),
            self.half_view[frame],
        )

    @property
    def real(self) -> np.ndarray:
        """(F, N) bool, which keypoints are real."""
        return np.arange(self.points.shape[1]) < self.count[:, None]
