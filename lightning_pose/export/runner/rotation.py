"""Rotations: the part of scipy's `Rotation` that locating uses, so that an exported folder needs no scipy."""

from __future__ import annotations

import numpy as np

__all__ = ["Rotation"]


class Rotation:
    """One rotation, or several, as rotation matrices (..., 3, 3)."""

    def __init__(self, matrix: np.ndarray) -> None:
        self.matrix = matrix

    @classmethod
    def from_matrix(cls, matrix: np.ndarray) -> Rotation:
        """Of rotation matrices (..., 3, 3)."""
        return cls(np.asarray(matrix, np.float64))

    @classmethod
    def from_rotvec(cls, rotvec: np.ndarray) -> Rotation:
        """Of axes times angles in radians (..., 3), by Rodrigues' formula."""
        rotvec = np.asarray(rotvec, np.float64)
        angle = np.linalg.norm(rotvec, axis=-1)[..., None, None]
        x, y, z = np.moveaxis(rotvec, -1, 0)
        zero = np.zeros_like(x)
        cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
        # sin(a) / a and (1 - cos(a)) / a^2, also at 0
        return cls(np.eye(3) + np.sinc(angle / np.pi) * cross + np.sinc(angle / (2 * np.pi)) ** 2 / 2 * cross @ cross)

    def as_matrix(self) -> np.ndarray:
        """(..., 3, 3)."""
        return self.matrix

    def as_quat(self, *, canonical: bool = False, scalar_first: bool = True) -> np.ndarray:
        """(..., 4) unit quaternions, w first; with `canonical`, w is not below 0."""
        assert scalar_first
        m = self.matrix
        trace = np.trace(m, axis1=-2, axis2=-1)[..., None]
        diagonal = np.diagonal(m, axis1=-2, axis2=-1)
        squares = np.concatenate([trace, 2 * diagonal - trace], axis=-1)  # 4 w^2 - 1, 4 x^2 - 1, ...
        a, b, c = m[..., 2, 1], m[..., 0, 2], m[..., 1, 0]
        d, e, f = m[..., 1, 2], m[..., 2, 0], m[..., 0, 1]
        square = 1 + squares
        products = np.stack(
            [
                np.stack([square[..., 0], a - d, b - e, c - f], axis=-1),
                np.stack([a - d, square[..., 1], c + f, b + e], axis=-1),
                np.stack([b - e, c + f, square[..., 2], a + d], axis=-1),
                np.stack([c - f, b + e, a + d, square[..., 3]], axis=-1),
            ],
            axis=-2,
        )  # row i is 4 q_i q; the row of the largest q_i loses no digits
        largest = square.argmax(axis=-1)[..., None, None]
        quat = np.take_along_axis(products, np.broadcast_to(largest, (*largest.shape[:-1], 4)), axis=-2)[..., 0, :]
        quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
        return np.where(quat[..., :1] < 0, -quat, quat) if canonical else quat

    def as_rotvec(self) -> np.ndarray:
        """(..., 3), axes times angles in radians up to pi."""
        quat = self.as_quat(canonical=True)
        half = np.arctan2(np.linalg.norm(quat[..., 1:], axis=-1), quat[..., 0])[..., None]
        return quat[..., 1:] * 2 / np.sinc(half / np.pi)  # sin(half) / half, also at 0
