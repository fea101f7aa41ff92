"""Determinants and their maxima on a CPU: calls that are listed once for images of a size, strip of rows by strip.

What a strip needs stays in the processor's cache, no memory is new (page faults take as long as the sums), and OpenCV
subtracts whole numbers twice as fast as torch does. The numbers are those of `hessian`, bit for bit.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from lightning_pose.features.surf.hessian import compute_filter_size, compute_margin, find_lobe_edges, scale_determinant

__all__ = ["StripProgram", "get_program"]

STRIP = 2**15
"""Samples of a strip: ten planes of it fit a cache of 2 MB."""

LARGEST_FILTER = compute_filter_size(0, 3)
"""Of the layers here, in samples."""

LARGEST_KEPT = 2**21
"""Pixels of images whose program is kept for the next image; it has some 40 bytes a pixel."""

SQUARE = np.ones((3, 3), np.uint8)
BUFFERS = 4


class StripProgram:
    """Finds the maxima of the determinant in images of one size; not for two threads at once.

    Args:
        height: of the integral images.
        width: of the integral images.
        planes: (3, h, w) float32 of each octave: where determinants of layers 1 to 3 are written to.
        low: margin of the planes, in samples.
    """

    def __init__(self, height: int, width: int, planes: list[Tensor], low: int) -> None:
        self._integral = np.empty((height, width), np.int32)
        self._low = low
        self._steps: list[tuple[Any, ...]] = []
        self._marks: list[np.ndarray] = []
        for octave, plane in enumerate(planes):
            plane.zero_()  # where filters do not fit
            self._marks.append(np.zeros(plane.shape, bool))
            if plane.numel():
                self._phases: dict[tuple[int, int], np.ndarray] = {}
                self._add_octave(octave, plane)

    def run(self, integral: np.ndarray) -> list[np.ndarray]:
        """Fill the planes, and find where no neighbour in layers 1 to 3 exceeds a sample: places in each octave's."""
        np.copyto(self._integral, integral)
        for function, *arguments in self._steps:
            function(*arguments)
        return [np.flatnonzero(marks) for marks in self._marks]

    def _do(self, function: Callable[..., Any], *arguments: object) -> None:
        """Call this function with these arguments in each run."""
        self._steps.append((function, *arguments))

    def _add_octave(self, octave: int, planes: Tensor) -> None:
        _, height, width = planes.shape
        rows = max(STRIP // width, 8)
        size = (min(rows, height) + LARGEST_FILTER) * (width + LARGEST_FILTER)
        self._whole, self._turn = np.empty((BUFFERS, size), np.int32), 0
        self._real = torch.empty((4, size), device="cpu")
        done = 0
        for top in range(0, height, rows):
            bottom = min(top + rows, height)
            for layer, plane in enumerate(planes, 1):
                inset = max(compute_margin(layer) - self._low, 0)
                first, last = max(top, inset), min(bottom, height - inset)
                if first < last and width > 2 * inset:
                    out = plane[first:last, inset : width - inset]
                    self._add_strip(octave, layer, (self._low + first, self._low + inset), out)
            ready = bottom if bottom == height else bottom - 1  # the last row waits for its neighbours below
            self._add_maxima(planes.numpy(), self._marks[octave], done, ready)
            done = ready

    def _add_strip(self, octave: int, layer: int, first: tuple[int, int], out: Tensor) -> None:
        """A layer's determinants at the (n, m) samples from `first` on, into `out`."""
        (n, m), step, size = out.shape, 1 << octave, compute_filter_size(octave, layer)
        y0, x0 = ((sample - compute_margin(layer)) * step for sample in first)
        lobe, near, far, one, other = find_lobe_edges(size)
        t, apart = lobe // step, other - one
        subtract = self._subtract

        def change(y: int, x: int, down: int, along: int, rows: int, columns: int) -> np.ndarray:
            """The integral's change from one pixel to another, `down` and `along` from it."""
            end = self._view(octave, y0 + y + down, x0 + x + along, rows, columns)
            return subtract(end, self._view(octave, y0 + y, x0 + x, rows, columns))

        # Three differences are a sum over three adjoining lobes with weights 1, -2, 1.
        band = change(near, 0, far - near, 0, n, m + 3 * t)
        for _ in range(3):
            band = subtract(band[:, t:], band[:, :-t])
        dxx = self._convert(band, 0)
        band = change(0, near, 0, far - near, n + 3 * t, m)
        for _ in range(3):
            band = subtract(band[t:], band[:-t])
        dyy = self._convert(band, 1)

        if apart % step:  # the lobes of dxy are not always whole samples apart
            sides = []
            for number, x in ((2, one), (3, other)):
                band = subtract(*(change(y, x, lobe, 0, n, m + t) for y in (other, one)))
                sides.append(self._convert(subtract(band[:, t:], band[:, :-t]), number))
            dxy = sides[1]
            self._do(dxy.sub_, sides[0])
        else:
            c = apart // step
            band = change(one, one, lobe, 0, n + c, m + c + t)
            band = subtract(band[c:], band[:-c])
            band = subtract(band[:, t:], band[:, :-t])
            dxy = self._convert(subtract(band[:, c:], band[:, :-c]), 2)
        of_dxy, of_all = scale_determinant(size)
        self._do(dxx.mul_, dyy)
        self._do(partial(dxx.addcmul_, value=-of_dxy), dxy, dxy)
        self._do(partial(torch.mul, out=out), dxx, of_all)

    def _add_maxima(self, planes: np.ndarray, marks: np.ndarray, first: int, last: int) -> None:
        """Marks in rows from `first` to `last` of planes (3, h, w), whose rows beside these are known."""
        _, height, width = planes.shape
        start = max(first - 1, 0)
        one, two, three = layers = planes[:, start : last + 1]
        lower, upper, every, peak = (buffer[: one.size].reshape(one.shape) for buffer in self._real.numpy())
        self._do(cv2.max, one, two, lower)
        self._do(cv2.max, two, three, upper)
        self._do(cv2.max, lower, three, every)
        for k, highest in enumerate((lower, every, upper)):
            inset = compute_margin(k + 2) + 1 - self._low  # one sample more than the filters of the layer above need
            top, bottom = max(first, inset), min(last, height - inset)
            if top >= bottom or width <= 2 * inset:
                continue
            inner = slice(top - start, bottom - start), slice(inset, width - inset)
            self._do(cv2.dilate, highest, SQUARE, peak)
            self._do(np.greater_equal, layers[k][inner], peak[inner], marks[k, top:bottom, inset : width - inset])

    def _view(self, octave: int, y: int, x: int, rows: int, columns: int) -> np.ndarray:
        """(rows, columns) of the integral image in steps of 2**octave pixels, from pixel (y, x) on."""
        step = 1 << octave
        phase = y % step, x % step
        if step == 1:
            self._phases[phase] = self._integral
        if phase not in self._phases:
            part = self._integral[phase[0] :: step, phase[1] :: step]
            self._phases[phase] = np.empty(part.shape, np.int32)
            self._do(np.copyto, self._phases[phase], part)
        y, x = y >> octave, x >> octave
        return self._phases[phase][y : y + rows, x : x + columns]

    def _subtract(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """a - b; lasts until BUFFERS more are subtracted."""
        self._turn = (self._turn + 1) % BUFFERS
        difference = self._whole[self._turn, : a.size].reshape(a.shape)
        self._do(cv2.subtract, a, b, difference)
        return difference

    def _convert(self, values: np.ndarray, number: int) -> Tensor:
        """Values as float32, in the memory of this number."""
        real = self._real[number, : values.size].view(values.shape)
        self._do(real.copy_, torch.from_numpy(values))
        return real


_kept = threading.local()


def get_program(height: int, width: int, make: Callable[[], Any]) -> Any:
    """What `make` returns for images of this size: the same as for this thread's last image, if that was as large."""
    if getattr(_kept, "size", None) != (height, width):
        _kept.size = None  # what was kept is freed before there is more
        _kept.program = None
        with torch.inference_mode(False):  # tensors made in that mode could not be written to outside it
            program = make()
        if height * width > LARGEST_KEPT:
            return program
        _kept.program, _kept.size = program, (height, width)
    return _kept.program
