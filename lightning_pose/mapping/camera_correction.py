"""CameraCorrection: small errors of the camera that is given for a map."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

__all__ = ["CameraCorrection"]


@dataclass(frozen=True)
class CameraCorrection:
    """Small errors of the assumed camera, as far as the map needs them. They are no calibration.

    Attributes:
        scale: true focal length by the assumed one.
        centre: (2,) true principal point less the assumed one, in normalised image coordinates.
        k1: first radial distortion coefficient.
    """

    scale: float = 1.0
    centre: np.ndarray = field(default_factory=lambda: np.zeros(2))
    k1: float = 0.0

    def distort(self, points: np.ndarray) -> np.ndarray:
        """Where (..., 2) ideal points appear under the assumed camera."""
        squared = (points**2).sum(axis=-1, keepdims=True)
        return self.scale * points * (1 + self.k1 * squared) + self.centre

    def remove(self, points: np.ndarray) -> np.ndarray:
        """The ideal points of (..., 2) points under the assumed camera: the inverse of `distort`."""
        distorted = (points - self.centre) / self.scale
        ideal = distorted
        for _ in range(5):
            ideal = distorted / (1 + self.k1 * (ideal**2).sum(axis=-1, keepdims=True))
        return ideal
