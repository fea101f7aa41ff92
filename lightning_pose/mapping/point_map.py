"""PointMap: points of a scene with their descriptors, and the training frames that saw them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from lightning_pose.mapping.camera_correction import CameraCorrection
from lightning_pose.mapping.frames import find_turn_rates

__all__ = ["PointMap", "quantize_descriptors"]

LARGEST = 127
"""The largest element of a stored descriptor."""


@dataclass(frozen=True)
class PointMap:
    """P points, seen O times by F training frames.

    Positions are in the scene's unit. All fields are arrays, so that a map is stored as it is.

    Attributes:
        points: (P, 3) float64.
        descriptors: (P, D) int8; `unit_descriptors` returns them at unit length.
        log_size: (P,) float32, mean log2 of the keypoint's diameter as an angle (radians) times its distance.
        direction: (P, 3) float32, mean direction from the point to the cameras that saw it, unit length.
        seen_point: (O,) int32, the point of each observation; observations are sorted by frame, then point.
        seen_count: (F,) int32, how many of them each frame has.
        rotation: (F, 3, 3) float64, camera-to-world rotation of each training frame as the map has it.
        position: (F, 3) float64.
        given_rotation: (F, 3, 3) float64, as the dataset has it; the same if no pose was adjusted.
        given_position: (F, 3) float64.
        camera: (5,) float64: scale, centre x and y, and k1 of the `CameraCorrection`, and `Adjustment.readout` (not
            in older maps).
    """

    points: np.ndarray
    descriptors: np.ndarray
    log_size: np.ndarray
    direction: np.ndarray
    seen_point: np.ndarray
    seen_count: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    given_rotation: np.ndarray
    given_position: np.ndarray
    camera: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    @property
    def unit_descriptors(self) -> np.ndarray:
        """(P, D) float32, L2-normalised."""
        full = self.descriptors.astype(np.float32)
        return full / np.maximum(np.linalg.norm(full, axis=1, keepdims=True), 1e-12)

    @property
    def camera_correction(self) -> CameraCorrection:
        """What was wrong with the assumed camera."""
        scale, x, y, k1 = self.camera[:4].tolist()
        return CameraCorrection(scale, np.array([x, y]), k1)

    @property
    def turns(self) -> np.ndarray:
        """(F, 3) by how much each camera turned while its rows were read, as `refine_turning_pose` takes it."""
        readout = float(self.camera[4]) if len(self.camera) > 4 else 0.0
        return readout * find_turn_rates(self.rotation)

    @property
    def seen_frame(self) -> np.ndarray:
        """(O,) int64, the frame of each observation."""
        return np.repeat(np.arange(len(self.seen_count)), self.seen_count)

    def measure_depth(self) -> float:
        """Median distance of the points from the frames that saw them; 1 for an empty map."""
        distance = np.linalg.norm(self.points[self.seen_point] - self.position[self.seen_frame], axis=1)
        return float(np.median(distance)) if len(distance) else 1.0

    def measure_covariances(self) -> np.ndarray:
        """(P, 3, 3) covariances of the points, if the frames that saw them err by 1 in normalised coordinates."""
        point, n = self.seen_point.astype(np.int64), len(self)
        ray = self.points[point] - self.position[self.seen_frame]
        squared = np.maximum((ray**2).sum(axis=1), np.finfo(float).tiny)
        across = np.bincount(point, 1 / squared, n)
        normal = np.empty((n, 3, 3))
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            along = np.bincount(point, ray[:, i] * ray[:, j] / squared**2, n)
            normal[:, i, j] = normal[:, j, i] = (across if i == j else 0) - along
        trace = np.trace(normal, axis1=1, axis2=2)[:, None, None]
        return np.linalg.inv(normal + np.eye(3) * (1e-6 * trace + np.finfo(float).tiny))

    @property
    def n_bytes(self) -> int:
        """Size of all arrays."""
        return sum(getattr(self, field.name).nbytes for field in fields(self))


def quantize_descriptors(descriptors: np.ndarray) -> np.ndarray:
    """(P, D) int8 of (P, D) float descriptors: each is scaled to its largest element."""
    largest = np.maximum(np.abs(descriptors).max(axis=1, keepdims=True), 1e-12)
    return np.rint(descriptors / largest * LARGEST).astype(np.int8)
