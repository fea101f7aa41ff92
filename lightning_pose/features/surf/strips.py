"""Determinants and their maxima on a CPU, in strips of rows: what a strip needs stays in the processor's cache.

The numbers are those of `hessian`, bit for bit. OpenCV subtracts whole numbers twice as fast as torch does.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch

from lightning_pose.features.surf.hessian import (
    combine_derivatives,
    compute_filter_size,
    compute_margin,
    find_lobe_edges,
)

__all__ = ["fill_octave"]

STRIP = 2**15
"""Samples of a strip: ten planes of it fit a cache of 2 MB."""

LARGEST_FILTER = compute_filter_size(0, 3)
"""Of the layers here, in samples."""

SQUARE = np.ones((3, 3), np.uint8)

Maxima = tuple[np.ndarray, np.ndarray]
"""Layers less 1, and places in the plane (row * width + column)."""


class _Corners:
    """An integral image in steps of 2**octave pixels, from any pixel on.

    Args:
        integral: (H + 1, W + 1) int32.
        octave: the number of the octave.
    """

    def __init__(self, integral: np.ndarray, octave: int) -> None:
        self._integral, self._octave = integral, octave
        self._phases: dict[tuple[int, int], np.ndarray] = {}

    def view(self, y: int, x: int, rows: int, columns: int) -> np.ndarray:
        """(rows, columns) int32, from pixel (y, x) on."""
        step = 1 << self._octave
        phase = y % step, x % step
        if phase not in self._phases:
            self._phases[phase] = np.ascontiguousarray(self._integral[phase[0] :: step, phase[1] :: step])
        y, x = y >> self._octave, x >> self._octave
        return self._phases[phase][y : y + rows, x : x + columns]


class _Scratch:
    """Memory for one strip after the other.

    Args:
        size: largest number of elements of an array.
    """

    def __init__(self, size: int) -> None:
        self._whole = np.empty((4, size), np.int32)
        self._real = torch.empty((4, size), device="cpu")
        self._turn = 0

    def subtract(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """a - b; lasts until four more are subtracted."""
        self._turn = (self._turn + 1) % 4
        return cv2.subtract(a, b, dst=self._whole[self._turn, : a.size].reshape(a.shape))

    def convert(self, values: np.ndarray, number: int) -> torch.Tensor:
        """Values as float32, in the memory of this number."""
        return self._real[number, : values.size].view(values.shape).copy_(torch.from_numpy(values))


def fill_octave(
    integral: np.ndarray, octave: int, low: int, threshold: float, planes: torch.Tensor
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Compute the determinants of layers 1 to 3, and list those above the threshold that no neighbour exceeds.

    Args:
        integral: (H + 1, W + 1) int32.
        octave: the number of the octave.
        low: margin of the planes, in samples.
        threshold: at least 0.
        planes: (3, h, w) float32, written to; zero where a filter does not fit.

    Returns:
        layers less 1 (M,), and places in the plane (M,), row by row; for one part of the octave after the other.
    """
    _, height, width = planes.shape
    rows = max(STRIP // width, 8)
    corners = _Corners(integral, octave)
    scratch = _Scratch((min(rows, height) + LARGEST_FILTER) * (width + LARGEST_FILTER))
    found, done = [], 0
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        for layer, plane in enumerate(planes, 1):
            inset = max(compute_margin(layer) - low, 0)
            if inset:
                plane[top:bottom].zero_()
            first, last = max(top, inset), min(bottom, height - inset)
            if first < last and width > 2 * inset:
                out = plane[first:last, inset : width - inset]
                _compute_strip(corners, octave, layer, (low + first, low + inset), scratch, out)
        ready = bottom if bottom == height else bottom - 1  # the last row waits for its neighbours below
        found += _list_maxima(planes.numpy(), done, ready, low, threshold)
        done = ready
    return found


def _compute_strip(
    corners: _Corners, octave: int, layer: int, first: tuple[int, int], scratch: _Scratch, out: torch.Tensor
) -> None:
    """Write a layer's determinants at the (n, m) samples from `first` on into `out`."""
    (n, m), step, size = out.shape, 1 << octave, compute_filter_size(octave, layer)
    y0, x0 = ((sample - compute_margin(layer)) * step for sample in first)
    lobe, near, far, one, other = find_lobe_edges(size)
    t, apart = lobe // step, other - one
    subtract = scratch.subtract

    def change(y: int, x: int, down: int, along: int, rows: int, columns: int) -> np.ndarray:
        """The integral's change from one pixel to another, `down` and `along` from it."""
        far = corners.view(y0 + y + down, x0 + x + along, rows, columns)
        return subtract(far, corners.view(y0 + y, x0 + x, rows, columns))

    # Three differences are a sum over three adjoining lobes with weights 1, -2, 1.
    band = change(near, 0, far - near, 0, n, m + 3 * t)
    for _ in range(3):
        band = subtract(band[:, t:], band[:, :-t])
    dxx = scratch.convert(band, 0)
    band = change(0, near, 0, far - near, n + 3 * t, m)
    for _ in range(3):
        band = subtract(band[t:], band[:-t])
    dyy = scratch.convert(band, 1)

    if apart % step:  # the lobes of dxy are not always whole samples apart
        sides = []
        for number, x in ((2, one), (3, other)):
            band = subtract(*(change(y, x, lobe, 0, n, m + t) for y in (other, one)))
            sides.append(scratch.convert(subtract(band[:, t:], band[:, :-t]), number))
        dxy = torch.sub(sides[1], sides[0], out=sides[0])
    else:
        c = apart // step
        band = change(one, one, lobe, 0, n + c, m + c + t)
        band = subtract(band[c:], band[:-c])
        band = subtract(band[:, t:], band[:, :-t])
        dxy = scratch.convert(subtract(band[:, c:], band[:, :-c]), 2)
    combine_derivatives(dxx, dyy, dxy, size, out)


def _list_maxima(planes: np.ndarray, first: int, last: int, low: int, threshold: float) -> list[Maxima]:
    """Maxima in rows from `first` to `last` of planes (3, h, w), whose rows beside these are known."""
    _, height, width = planes.shape
    start = max(first - 1, 0)
    one, two, three = planes[:, start : last + 1]
    upper = cv2.max(one, two), cv2.max(two, three)
    found = []
    for k, highest in enumerate((upper[0], cv2.max(upper[0], three), upper[1])):
        inset = compute_margin(k + 2) + 1 - low  # one sample more than the filters of the layer above need
        top, bottom = max(first, inset) - start, min(last, height - inset) - start
        if top >= bottom or width <= 2 * inset:
            continue
        inner = slice(top, bottom), slice(inset, width - inset)
        values = (one, two, three)[k][inner]
        at = np.flatnonzero(values >= cv2.dilate(highest, SQUARE)[inner])
        row, column = np.divmod(at, width - 2 * inset)
        above = values[row, column] > threshold
        place = (row[above] + (start + top)) * width + column[above] + inset
        found.append((np.full(len(place), k), place))
    return found
