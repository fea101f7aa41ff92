"""Orientations and descriptors of SURF in numpy, for one image at a time: the second half of `numpy_surf`."""

from __future__ import annotations

from itertools import product

import numpy as np

__all__ = ["UPRIGHT_ANGLE", "compute_orientations", "describe_surf"]

CELLS = 21
"""Cells along a side of a descriptor's window."""

UPRIGHT_ANGLE = 270.0
"""Of features whose orientation is not computed, degrees."""


def describe_surf(integral: np.ndarray, xy: np.ndarray, size: np.ndarray, angle: np.ndarray | None) -> np.ndarray:
    """Descriptors (K, 64) of unit length: 4 x 4 fields with the sums of dx, dy, |dx|, |dy|.

    Args:
        integral: (H + 1, W + 1) int32.
        xy: (K, 2), pixels.
        size: (K,), whole pixels.
        angle: (K,), degrees; None for upright windows.
    """
    if not len(xy):
        return np.zeros((0, 64), np.float32)
    window = np.floor(size * 14 / 5).astype(np.float32)
    if angle is None:
        patch = sample_upright_patch(integral, xy, window)
    else:
        patch = sample_rotated_patch(integral, xy, window, np.radians(angle))
    weight = np.exp(-((np.arange(20, dtype=np.float32) - 9.5) ** 2) / np.float32(2 * 3.3**2))[:, None]
    cells = np.eye(CELLS, dtype=np.float32)
    total, change = weight * (cells[1:] + cells[:-1]), weight * (cells[1:] - cells[:-1])
    smooth, across = (np.vstack([total, change]) @ patch.reshape(CELLS, -1)).reshape(2, 20, CELLS, -1)
    dx, dy = change @ smooth, total @ across
    responses = np.stack([dx, dy, np.abs(dx), np.abs(dy)], axis=2)  # (across, along, 4, K)
    fields = responses.reshape(20, 4, 5, 4, -1).sum(axis=2).reshape(4, 5, 4, 4, -1).sum(axis=1)
    rows = np.ascontiguousarray(fields.reshape(64, -1).T)
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)


def sample_upright_patch(integral: np.ndarray, xy: np.ndarray, window: np.ndarray) -> np.ndarray:
    """Grey sums of cells (21, 21, K), to the right and upwards, with cells on whole pixels as OpenCV has them."""
    x, y = xy.T
    half = (window - 1) / 2
    edge = np.arange(CELLS + 1, dtype=np.float32)[:, None] * (window / CELLS)
    sums = sample_integral(integral, np.round(y + half) + 1 - edge, np.round(x - half) + edge)
    columns = sums[:-1] - sums[1:]
    return np.ascontiguousarray((columns[:, 1:] - columns[:, :-1]).transpose(1, 0, 2))


def sample_rotated_patch(integral: np.ndarray, xy: np.ndarray, window: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Grey sums (21, 21, K) around the centres of rotated cells, which are parallel to the image's axes themselves."""
    cell = window / CELLS
    along = (np.arange(CELLS, dtype=np.float32) - CELLS // 2)[:, None] * cell
    u, v, cos, sin = along[:, None], along, np.cos(angle), np.sin(angle)
    edges = np.stack([-cell, cell])[:, None, None] / 2 + np.float32(0.5)
    x = edges + (xy[:, 0] + v * cos - u * sin)
    y = edges + (xy[:, 1] + v * sin + u * cos)
    sums = sample_integral(integral, y.reshape(2, -1), x.reshape(2, -1))
    return (sums[1, 1] - sums[0, 1] - sums[1, 0] + sums[0, 0]).reshape(CELLS, CELLS, -1)


def compute_orientations(integral: np.ndarray, xy: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Dominant gradient directions (K,), degrees in 0..360: the strongest 60-degree sector of a disc."""
    disc = np.array([(x, y) for x, y in product(range(-6, 7), repeat=2) if x * x + y * y <= 36], np.float32).T
    weight = np.exp(-(disc**2).sum(axis=0) / np.float32(2 * 2.5**2))[:, None]
    scale = size * np.float32(1.2 / 9)
    half = np.round(2 * scale)  # half the wavelet's side
    corner = np.round(xy.T[:, None] + disc[..., None] * scale - (half - np.float32(0.5)))  # (2, 113, K)
    limit = np.array([integral.shape[1], integral.shape[0]]).reshape(2, 1, 1) - 2 * half
    inside = ((corner >= 0) & (corner < limit)).all(axis=0)
    x, y = (corner * inside)[:, None] + half * np.arange(3).reshape(3, 1, 1)
    sums = sample_integral(integral, y.reshape(3, -1), x.reshape(3, -1)).reshape(3, 3, *inside.shape)
    dx = compute_second_difference(sums[2] - sums[0]) * weight * inside
    dy = compute_second_difference(sums[:, 2] - sums[:, 0]) * weight * inside
    degree = np.round(np.degrees(np.arctan2(dy, dx))).astype(np.int64) % 360
    place = (degree + 360 * np.arange(len(size))).ravel()
    histogram = np.stack([np.bincount(place, part.ravel(), 360 * len(size)) for part in (dx, dy)])
    around = histogram.reshape(2, -1, 360).transpose(0, 2, 1)
    around = np.concatenate([around[:, -29:], around, around[:, :29]], axis=1)
    around = np.concatenate([np.zeros_like(around[:, :1]), around.cumsum(axis=1)], axis=1)
    sectors = (around[:, 59:] - around[:, :-59])[:, ::5]  # every 5 degrees, 29 to each side
    best = (sectors**2).sum(axis=0).argmax(axis=0)
    x, y = np.take_along_axis(sectors, best[None, None], axis=1)[:, 0]
    return (np.degrees(np.arctan2(y, x)) % 360).astype(np.float32)


def compute_second_difference(a: np.ndarray) -> np.ndarray:
    """Second difference of three neighbours along the first axis."""
    return a[0] - 2 * a[1] + a[2]


def sample_integral(integral: np.ndarray, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Integrals (R, C, K) at R fractional rows and C columns of each of K places, up to terms of one axis.

    Such terms cancel in every box sum; without them the numbers are small enough for float32. Outside the image the
    border pixels are repeated.
    """
    rows, down = find_lattice_cells(y, integral.shape[0])
    cols, across = find_lattice_cells(x, integral.shape[1])
    sums = integral.reshape(-1).take((rows * integral.shape[1])[:, None] + cols)
    sums = (sums - sums[:1] - (sums[:, :1] - sums[:1, :1])).astype(np.float32)
    above, below = sums[: len(y)], sums[len(y) :]
    sums = above + (below - above) * down[:, None]
    left, right = sums[:, : len(x)], sums[:, len(x) :]
    return left + (right - left) * across


def find_lattice_cells(position: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Whole numbers (2 * E, K) below and above each position, and the fraction (E, K) between them.

    Beyond the ends the two last numbers are used with a fraction outside 0..1: linear extrapolation.
    """
    below = np.clip(np.floor(position), 0, length - 2)
    cell = below.astype(np.int32)
    return np.concatenate([cell, cell + 1]), (position - below).astype(np.float32)
