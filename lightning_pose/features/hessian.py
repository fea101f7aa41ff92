"""SURF's detector: integral images and scale-space maxima of the box-filter Hessian's determinant.

Bay, Ess, Tuytelaars, Van Gool: "Speeded-Up Robust Features", 2008, section 3. Filter sizes, sampling and
the maximum search are laid out as OpenCV does it: 4 octaves of 3 searched layers, octave o sampled every
2**o pixels. A pixel's centre is at integer coordinates.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Detections", "detect", "integral_image"]

OCTAVES = 4
LAYERS = 5
"""Layers of an octave: three are searched, the outer two only bound the search."""
REFINE = 2
"""Candidates looked at in one go, as a multiple of the features wanted; about two thirds survive."""


class Detections(NamedTuple):
    """The strongest features of each image, strongest first, zero rows at the end.

    Attributes:
        xy: (B, N, 2) float32, pixels, sub-pixel.
        size: (B, N) float32, side of the Hessian filter in whole pixels; the scale is 1.2 / 9 of it.
        response: (B, N) float32, the determinant, of grey values 0..255.
        count: (B,) int64, how many of the N rows are real.
    """

    xy: Tensor
    size: Tensor
    response: Tensor
    count: Tensor


def integral_image(gray: Tensor) -> Tensor:
    """(B, H, W) uint8 -> (B, H + 1, W + 1) int32: [:, y, x] is the sum over rows < y and columns < x.

    On huge images the sums wrap around, and every box sum below 2**31 is still exact.
    """
    rows = torch.cumsum(gray, 2, dtype=torch.int32)
    integral = gray.new_zeros((gray.shape[0], gray.shape[1] + 1, gray.shape[2] + 1), dtype=torch.int32)
    torch.cumsum(rows, 1, dtype=torch.int32, out=integral[:, 1:, 1:])
    return integral


def detect(integral: Tensor, n: int, threshold: float) -> Detections:
    """The n strongest features of each image whose determinant is above the threshold.

    Args:
        integral: (B, H + 1, W + 1) int32 integral images.
        n: rows to return per image.
        threshold: smallest determinant that counts, on OpenCV's hessianThreshold scale.
    """
    octaves = [_candidates(integral, octave, threshold) for octave in range(OCTAVES)]
    candidates = [torch.cat(column) for column in zip(*octaves, strict=True)]
    order = torch.argsort(candidates[-1], descending=True, stable=True)
    order = order[torch.argsort(candidates[0][order], stable=True)]
    image, layer, row, col, response = (column[order] for column in candidates)
    rank = _rank(image, integral.shape[0])
    found: list[tuple[Tensor, ...]] = []
    batch = integral.shape[0]
    count = torch.zeros(batch, dtype=torch.int64, device=integral.device)
    for first in range(0, _longest(image, batch), REFINE * n):
        pick = ((rank >= first) & (rank < first + REFINE * n)).nonzero().squeeze(1)
        ok, xy, size = _refine(integral, image[pick], layer[pick], row[pick], col[pick])
        found.append((image[pick][ok], xy[ok], size[ok], response[pick][ok]))
        count += torch.bincount(found[-1][0], minlength=batch)
        if bool((count >= n).all()):
            break
    return _pack(found, batch, n, integral.device)


def _longest(image: Tensor, batch: int) -> int:
    return int(torch.bincount(image, minlength=batch).max()) if len(image) else 0


def _rank(image: Tensor, batch: int) -> Tensor:
    """Position of each entry among those of its image; `image` is sorted."""
    count = torch.bincount(image, minlength=batch)
    return torch.arange(len(image), device=image.device) - (count.cumsum(0) - count)[image]


def _pack(found: list[tuple[Tensor, ...]], batch: int, n: int, device: torch.device) -> Detections:
    xy = torch.zeros((batch, n, 2), device=device)
    size, response = torch.zeros((2, batch, n), device=device)
    count = torch.zeros(batch, dtype=torch.int64, device=device)
    if found:
        image, *columns = (torch.cat(column) for column in zip(*found, strict=True))
        order = torch.argsort(image, stable=True)
        image = image[order]
        rank = _rank(image, batch)
        keep = rank < n
        where = (image[keep], rank[keep])
        for target, column in zip((xy, size, response), columns, strict=True):
            target[where] = column[order][keep]
        count = torch.bincount(image, minlength=batch).clamp(max=n)
    return Detections(xy, size, response, count)


def _size(octave: int, layer: int) -> int:
    """Side of the box filter, pixels."""
    return (9 + 6 * layer) << octave


def _margin(octave: int, layer: int) -> int:
    """Half the filter's side, in samples of the octave."""
    return _size(octave, layer) // 2 >> octave


def _edges(size: int) -> tuple[int, int, int, int, int, int]:
    """The paper's 9x9 filters, scaled: lobe; near and far edge of a long side; first and second
    diagonal lobe; their distance."""
    first, second = round(size / 9), round(size * 5 / 9)
    return size // 3, round(size * 2 / 9), round(size * 7 / 9), first, second, second - first


def _candidates(integral: Tensor, octave: int, threshold: float) -> tuple[Tensor, ...]:
    """Samples of the searched layers that no neighbour in these layers exceeds.

    Returns:
        image, layer (octave * LAYERS + layer), row, column (samples) and determinant, one entry each.
    """
    batch, height, width = integral.shape
    rows, cols = (height - 1) >> octave, (width - 1) >> octave
    low = _margin(octave, 2)
    shape = (batch, max(rows - 2 * low, 0), max(cols - 2 * low, 0))
    dets = integral.new_zeros((3, *shape), dtype=torch.float32)
    for layer in (1, 2, 3):
        inset = _margin(octave, max(layer, 2)) - low
        inner = (shape[1] - 2 * inset, shape[2] - 2 * inset)
        if min(inner) > 0:
            start = (low + inset - _margin(octave, layer)) << octave
            dets[layer - 1][:, inset : inset + inner[0], inset : inset + inner[1]] = _determinant(
                integral, _size(octave, layer), 1 << octave, start, inner
            )
    found = []
    for layer in (1, 2, 3):
        inset = _margin(octave, layer + 1) + 1 - low
        if min(shape[1:]) <= 2 * inset:
            continue
        near = dets[max(layer - 2, 0) : layer + 1].amax(0)[:, inset - 1 : shape[1] - inset + 1]
        near = torch.maximum(torch.maximum(near[:, :-2], near[:, 1:-1]), near[:, 2:])
        near = near[:, :, inset - 1 : shape[2] - inset + 1]
        near = torch.maximum(torch.maximum(near[:, :, :-2], near[:, :, 1:-1]), near[:, :, 2:])
        det = dets[layer - 1][:, inset : shape[1] - inset, inset : shape[2] - inset]
        image, row, col = ((det >= near) & (det > threshold)).nonzero().unbind(1)
        offset = low + inset
        found.append(
            (
                image,
                torch.full_like(row, octave * LAYERS + layer),
                row + offset,
                col + offset,
                det[image, row, col],
            )
        )
    empty = integral.new_zeros(0, dtype=torch.int64)
    found.append((empty, empty, empty, empty, empty.float()))
    return tuple(torch.cat(column) for column in zip(*found, strict=True))


def _determinant(integral: Tensor, size: int, step: int, start: int, shape: tuple[int, int]) -> Tensor:
    """(B, *shape) determinants of one filter size; the first filter's corner is at (start, start)."""
    lobe, near, far, first, _, apart = _edges(size)
    n, m = shape
    t = lobe // step

    def corners(y: int, x: int, rows: int, cols: int, stride: int = step) -> Tensor:
        y, x = y + start, x + start
        return integral[:, y : y + (rows - 1) * stride + 1 : stride, x : x + (cols - 1) * stride + 1 : stride]

    band = corners(far, 0, n, m + 3 * t) - corners(near, 0, n, m + 3 * t)
    dxx = (band[..., 3 * t :] - band[..., :m]).sub_(band[..., 2 * t : 2 * t + m] - band[..., t : t + m], alpha=3)
    band = corners(0, far, n + 3 * t, m) - corners(0, near, n + 3 * t, m)
    dyy = (band[:, 3 * t :] - band[:, :n]).sub_(band[:, 2 * t : 2 * t + n] - band[:, t : t + n], alpha=3)

    grid = math.gcd(step, apart)  # the four lobes of dxy do not lie on the sampling grid of every layer
    u, c, t = step // grid, apart // grid, lobe // grid
    rows, cols = (n - 1) * u + 1, (m - 1) * u + 1
    high, wide = rows + c, cols + c + t
    band = corners(first + lobe, first, high, wide, grid) - corners(first, first, high, wide, grid)
    band = band[:, :rows:u] - band[:, c::u]
    band = band[..., t:] - band[..., :-t]
    dxy = band[..., :cols:u] - band[..., c::u]

    area, lobe_area = lobe * (far - near), lobe * lobe
    det = (dxx * (1 / area)).mul_(dyy * (1 / area))
    dxy = dxy * (0.9 / lobe_area)
    return det.addcmul_(dxy, dxy, value=-1)


@lru_cache(maxsize=4)
def _filters(device: torch.device) -> tuple[Tensor, ...]:
    """Of every layer (octave * LAYERS + layer): the 32 corners (y, x) of its filters, their int32 weights,
    (dxx, dyy, dxy) normalisers, and (sampling step, margin, size)."""
    points, normalisers, grids = [], [], []
    for octave in range(OCTAVES):
        for layer in range(LAYERS):
            size = _size(octave, layer)
            lobe, near, far, first, second, _ = _edges(size)
            ends = ((near, -1), (far, 1))
            lobes = tuple((lobe * k, w) for k, w in enumerate((-1, 3, -3, 1)))
            cross = ((first, -1), (first + lobe, 1), (second, 1), (second + lobe, -1))
            pairs = [*((y, x) for y in ends for x in lobes), *((y, x) for y in lobes for x in ends)]
            pairs += [(y, x) for y in cross for x in cross]
            points.append([(y, x, wy * wx) for (y, wy), (x, wx) in pairs])
            normalisers.append((1 / (lobe * (far - near)), 1 / (lobe * (far - near)), 0.9 / lobe**2))
            grids.append((1 << octave, _margin(octave, layer), size))
    table = torch.tensor(points, dtype=torch.int32, device=device)
    return (
        table[..., :2].long(),
        table[..., 2],
        torch.tensor(normalisers, device=device),
        torch.tensor(grids, device=device),
    )


def _refine(integral: Tensor, image: Tensor, layer: Tensor, row: Tensor, col: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Keep strict maxima of their 3x3x3 neighbourhood and fit a quadric to it.

    Returns:
        ok (K,) bool; xy (K, 2) and size (K,) float32, sub-pixel and sub-scale.
    """
    stride = integral.shape[2]
    points, weights, normalisers, grids = _filters(integral.device)
    layers = layer[:, None] + torch.arange(-1, 2, device=layer.device)  # (K, 3)
    step, margin = grids[layers, 0], grids[layers, 1]
    near = torch.arange(-1, 2, device=layer.device)
    y = (row[:, None, None] - margin[:, :, None] + near) * step[:, :, None]  # (K, 3, 3)
    x = (col[:, None, None] - margin[:, :, None] + near) * step[:, :, None]
    corner = points[layers][:, :, None, None]  # (K, 3, 1, 1, 32, 2)
    index = (y[:, :, :, None, None] + corner[..., 0]) * stride + x[:, :, None, :, None] + corner[..., 1]
    index += (image * integral.stride(0)).view(-1, 1, 1, 1, 1)
    values = integral.view(-1)[index] * weights[layers][:, :, None, None]
    d = (
        torch.stack([part.sum(-1, dtype=torch.int32) for part in values.split((8, 8, 16), dim=-1)], dim=-1)
        * normalisers[layers][:, :, None, None]
    )
    det = d[..., 0] * d[..., 1] - d[..., 2].square()  # (K, 3, 3, 3): scale, y, x
    offset, fits = _fit(det)
    others = det.flatten(1)[:, [i for i in range(27) if i != 13]]
    ok = (det[:, 1, 1, 1] > others.amax(1)) & fits
    step, margin, size = grids[layer].unbind(1)
    base = torch.stack([col, row], 1) - margin[:, None]
    xy = (base * step[:, None] + (size[:, None] - 1) / 2) + offset[:, :2] * step[:, None]
    return ok, xy, torch.round(size + offset[:, 2] * 6 * step)


def _fit(det: Tensor) -> tuple[Tensor, Tensor]:
    """Peak of the quadric through (K, 3, 3, 3) samples: (K, 3) offsets (x, y, scale); is it inside."""
    centre = det[:, 1, 1, 1]
    minus, plus = (torch.stack([det[:, 1, 1, e], det[:, 1, e, 1], det[:, e, 1, 1]], 1) for e in (0, 2))
    gradient = (plus - minus) / 2
    dxx, dyy, dss = (plus - 2 * centre[:, None] + minus).unbind(1)
    dxy = (det[:, 1, 2, 2] - det[:, 1, 2, 0] - det[:, 1, 0, 2] + det[:, 1, 0, 0]) / 4
    dxs = (det[:, 2, 1, 2] - det[:, 2, 1, 0] - det[:, 0, 1, 2] + det[:, 0, 1, 0]) / 4
    dys = (det[:, 2, 2, 1] - det[:, 2, 0, 1] - det[:, 0, 2, 1] + det[:, 0, 0, 1]) / 4
    columns = [torch.stack(c, 1) for c in ((dxx, dxy, dxs), (dxy, dyy, dys), (dxs, dys, dss))]
    adjugate = [torch.linalg.cross(columns[i - 2], columns[i - 1]) for i in range(3)]
    determinant = (columns[0] * adjugate[0]).sum(1)
    offset = -torch.stack([(a * gradient).sum(1) for a in adjugate], 1) / determinant[:, None]
    return offset, (offset.abs() <= 1).all(1)
