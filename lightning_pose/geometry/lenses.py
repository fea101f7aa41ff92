"""COLMAP's lens models that OpenCV does not have: FOV, and fisheye lenses whose sensor is tilted (thin prism)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

__all__ = ["LENS_PARAMETERS", "distort_points", "undistort_points"]

LENS_PARAMETERS = {
    "FOV": ("omega",),
    "THIN_PRISM_FISHEYE": ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3"),
}
"""Their coefficients in COLMAP's order. No two have the same number, so that the number says which model it is."""

NO_RAY = -1e6
"""Coordinate of a pixel that no ray in front of the camera reaches, as OpenCV's fisheye functions have it."""

WIDEST_RAD = np.pi / 2 - 1e-6
STEPS = 30


def distort_points(points: Float[np.ndarray, "n 2"], coefficients: tuple[float, ...]) -> Float[np.ndarray, "n 2"]:
    """Where rays meet the image of a camera of focal length 1 with one of these lenses.

    Devernay & Faugeras, "Straight lines have to be straight", 2001 (FOV); Weng et al., PAMI 1992 (thin prism).

    Args:
        points: x and y of the rays at depth 1.
        coefficients: 1, 8 or 12 of them, see `LENS_PARAMETERS`.

    >>> distort_points(np.array([[0.0, 1.0]]), (1.0,)).round(4).tolist()
    [[0.0, 0.8296]]
    """
    radius = np.linalg.norm(points, axis=1, keepdims=True)
    if len(coefficients) == 1:
        omega = coefficients[0]
        if abs(omega) < 1e-8:
            return points.astype(np.float64)
        bent = np.arctan(radius * 2 * np.tan(omega / 2)) / omega
        return points * np.divide(
            bent, radius, out=np.full_like(radius, 2 * np.tan(omega / 2) / omega), where=radius > 0
        )
    angles = points * np.divide(np.arctan(radius), radius, out=np.ones_like(radius), where=radius > 0)
    return _bend_angles(angles, coefficients)


def undistort_points(distorted: Float[np.ndarray, "n 2"], coefficients: tuple[float, ...]) -> Float[np.ndarray, "n 2"]:
    """The rays of image points: the inverse of `distort_points`; -1e6 where no ray in front of the camera goes there.

    >>> undistort_points(np.array([[0.0, 0.8296]]), (1.0,)).round(3).tolist()
    [[0.0, 1.0]]
    """
    radius = np.linalg.norm(distorted, axis=1, keepdims=True)
    if len(coefficients) == 1:
        omega = coefficients[0]
        if abs(omega) < 1e-8:
            return distorted.astype(np.float64)
        reached = radius * abs(omega) < WIDEST_RAD
        straight = np.tan(np.where(reached, radius * omega, 0)) / (2 * np.tan(omega / 2))
        limit = np.full_like(radius, omega / (2 * np.tan(omega / 2)))
        return np.where(reached, distorted * np.divide(straight, radius, out=limit, where=radius > 0), NO_RAY)
    angles = _unbend_angles(distorted, coefficients)
    angle = np.linalg.norm(angles, axis=1, keepdims=True)
    reached = np.isfinite(angle) & (angle < WIDEST_RAD)
    angle = np.where(reached, angle, 0)
    rays = angles * np.divide(np.tan(angle), angle, out=np.ones_like(angle), where=angle > 0)
    return np.where(reached, rays, NO_RAY)


def _bend_angles(angles: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Image points (N, 2) of rays by their angles from the axis (N, 2), in radians, across and down."""
    if len(coefficients) == 8:
        k1, k2, p1, p2, k3, k4, sx1, sy1 = coefficients
        radial, prisms = (k1, k2, k3, k4), ((sx1, 0.0), (sy1, 0.0))
        bent, (tangential_x, tangential_y) = angles, (p2, p1)
    else:
        *radial, tangential_x, tangential_y, s0, s1, s2, s3 = coefficients
        prisms = ((s0, s1), (s2, s3))
        bent = angles * (1 + _sum_powers(radial, (angles**2).sum(axis=1)))[:, None]
    x, y = bent.T
    squared = x * x + y * y
    more = np.stack(
        [
            tangential_x * (squared + 2 * x * x) + 2 * tangential_y * x * y + _sum_powers(prisms[0], squared),
            tangential_y * (squared + 2 * y * y) + 2 * tangential_x * x * y + _sum_powers(prisms[1], squared),
        ],
        axis=1,
    )
    if len(coefficients) == 8:
        more += angles * _sum_powers(radial, squared)[:, None]
    return bent + more


def _sum_powers(factors: tuple[float, ...] | list[float], squared: np.ndarray) -> np.ndarray:
    """The sum of factors times the first, second, third ... power of a squared radius."""
    return sum((factor * squared ** (i + 1) for i, factor in enumerate(factors)), np.zeros_like(squared))


def _unbend_angles(distorted: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Angles (N, 2) of which `_bend_angles` makes these image points, by Newton's method; nan where it finds none."""
    angles = distorted.astype(np.float64).copy()
    width = 1e-6
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            error = _bend_angles(angles, coefficients) - distorted
            columns = [
                (_bend_angles(angles + side, coefficients) - _bend_angles(angles - side, coefficients)) / (2 * width)
                for side in np.eye(2) * width
            ]
            (a, c), (b, d) = columns[0].T, columns[1].T
            inverse = np.stack([d * error[:, 0] - b * error[:, 1], a * error[:, 1] - c * error[:, 0]], axis=1)
            angles -= np.clip(inverse / (a * d - b * c)[:, None], -0.5, 0.5)
        missed = np.abs(_bend_angles(angles, coefficients) - distorted).max(axis=1, initial=0) > 1e-8
    return np.where(missed[:, None], np.nan, angles)
