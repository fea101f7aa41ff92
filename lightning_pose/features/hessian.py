"""SURF's detector: integral images and scale-space maxima of the box-filter Hessian's determinant.

Bay, Ess, Tuytelaars, Van Gool: "Speeded-Up Robust Features", 2008, section 3. Filter sizes, sampling and
the search for maxima are laid out as OpenCV does it: 4 octaves of 3 searched layers, octave o sampled
every 2**o pixels. A pixel's centre has integer coordinates.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import product
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

__all__ = ["Detections", "detect", "integral_image"]

OCTAVES = 4
LAYERS = 5
"""Layers of an octave: three are searched, the outer two only bound the search."""


Layers = TypeVar("Layers", int, Tensor)


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
        threshold: determinants up to this one do not count; OpenCV's hessianThreshold.
    """
    octaves = [_candidates(integral, octave, threshold) for octave in range(OCTAVES)]
    image, layer, row, col, score = (torch.cat(column) for column in zip(*octaves, strict=True))
    batch, total = integral.shape[0], len(image)
    scores = score.new_zeros((batch, total))
    scores[image, torch.arange(total, device=image.device)] = score
    scores, ranking = scores.sort(dim=1, descending=True, stable=True)

    # Refining costs more than ranking, and about two thirds survive it: from the top down, until n have.
    found = []
    enough = max(2 * n, 600)
    for first in range(0, total, enough):
        response, pick = scores[:, first : first + enough], ranking[:, first : first + enough]
        keep, x, y, size = _refine(integral, layer[pick], row[pick], col[pick])
        keep &= response > 0
        found.append(torch.stack([keep, x, y, size, response], -1).where(keep[..., None], 0))
        if sum(part[..., 0].sum(1) for part in found).min() >= n:
            break
    features = torch.cat([*found, score.new_zeros((batch, n, 5))], 1)
    strongest = features[..., 0].argsort(dim=1, descending=True, stable=True)[:, :n]
    features = features.gather(1, strongest[..., None].expand(-1, -1, 5))
    return Detections(features[..., 1:3], features[..., 3], features[..., 4], features[..., 0].sum(1).long())


def _size(octave: int, layer: int) -> int:
    """Side of a layer's box filter, pixels."""
    return (9 + 6 * layer) << octave


def _margin(layer: Layers) -> Layers:
    """Half a filter's side, in samples of its octave."""
    return 4 + 3 * layer


def _edges(size: int) -> tuple[int, int, int, int, int]:
    """The paper's 9 x 9 filters, scaled.

    Returns:
        width of a lobe; near and far edge of a lobe's long side; near edges of the diagonal lobes.
    """
    near, far, first, second = (round(size * ninths / 9) for ninths in (2, 7, 1, 5))
    return size // 3, near, far, first, second


def _candidates(integral: Tensor, octave: int, threshold: float) -> tuple[Tensor, ...]:
    """Samples of an octave's searched layers that no neighbour in these layers exceeds.

    Returns:
        image, layer (octave * LAYERS + layer), row and column (samples), determinant: one entry each.
    """
    batch, height, width = integral.shape
    rows, cols = (height - 1) >> octave, (width - 1) >> octave
    low = _margin(2)  # the first sample that is a neighbour of a possible maximum
    if min(rows, cols) <= 2 * low + 2:
        nothing = integral.new_zeros(0, dtype=torch.int64)
        return nothing, nothing, nothing, nothing, nothing.float()
    height, width = rows - 2 * low, cols - 2 * low
    det = [torch.zeros((batch, height, width), device=integral.device) for _ in range(3)]
    for layer, plane in enumerate(det, 1):
        inset = max(_margin(layer) - low, 0)
        inner = plane[:, inset : height - inset, inset : width - inset]
        if inner.numel():
            start = (low + inset - _margin(layer)) << octave
            _determinant(integral, _size(octave, layer), 1 << octave, start, inner)

    # Comparing in place, in float32, is several times faster than making masks.
    lower, upper = torch.maximum(det[0], det[1]), torch.maximum(det[1], det[2])
    highest = [_around(plane) for plane in (lower, torch.maximum(lower, det[2]), upper)]
    least = float(np.nextafter(np.float32(threshold), np.float32(np.inf)))
    peaks = [h.clamp_(min=least).le_(plane[:, 1:-1, 1:-1]) for h, plane in zip(highest, det, strict=True)]
    bits = peaks[0].add_(peaks[1], alpha=2).add_(peaks[2], alpha=4).flatten()
    at = _nonzero(bits)
    layer, entry = (bits[at].int() & torch.tensor([[1], [2], [4]], device=at.device)).nonzero().unbind(1)
    line, col = _divmod(at, width - 2)
    image, row = _divmod(line, height - 2)
    score = torch.stack([plane[image, row + 1, col + 1] for plane in det])[layer, entry]
    image, row, col = image[entry], row[entry] + 1, col[entry] + 1
    layer, row, col = layer + 1, row + low, col + low
    border = 8 + 3 * layer  # one sample more than the margin of the layer above
    inside = (row >= border) & (row < rows - border) & (col >= border) & (col < cols - border)
    inside = inside.nonzero().squeeze(1)
    return tuple(column[inside] for column in (image, layer + octave * LAYERS, row, col, score))


def _around(plane: Tensor) -> Tensor:
    """(B, h, w) -> (B, h - 2, w - 2): the largest of each 3 x 3 neighbourhood."""
    high = torch.maximum(plane[:, :-2], plane[:, 2:])
    torch.maximum(high, plane[:, 1:-1], out=high)
    wide = torch.maximum(high[..., :-2], high[..., 2:])
    return torch.maximum(wide, high[..., 1:-1], out=wide)


def _divmod(a: Tensor, b: int) -> tuple[Tensor, Tensor]:
    quotient = torch.div(a, b, rounding_mode="floor")
    return quotient, a - quotient * b


def _nonzero(values: Tensor) -> Tensor:
    """Where the (n,) values are not zero. Searching eight bytes at a time, as these are few."""
    flags = pad(values.bool(), (0, -len(values) % 8))
    words = flags.view(torch.int64).nonzero().squeeze(1)
    word, byte = flags.view(-1, 8)[words].nonzero().unbind(1)
    return words[word] * 8 + byte


def _determinant(integral: Tensor, size: int, step: int, start: int, out: Tensor) -> None:
    """Write one layer's determinants to `out` (B, n, m); the first filter's corner is at (start, start).

    Every sum of boxes is built from shifted differences of whole planes, each shared by many boxes.
    """
    lobe, near, far, first, second = _edges(size)
    (_, n, m), t = out.shape, lobe // step

    def corners(y: int, x: int, rows: int, cols: int, step: int = step) -> Tensor:
        plane, line, _ = integral.stride()
        offset = (start + y) * line + start + x
        return integral.as_strided((len(out), rows, cols), (plane, step * line, step), offset)

    band = corners(far, 0, n, m + 3 * t) - corners(near, 0, n, m + 3 * t)
    dxx = _lobes(*(band.narrow(2, k * t, m) for k in range(4)))
    band = corners(0, far, n + 3 * t, m) - corners(0, near, n + 3 * t, m)
    dyy = _lobes(*(band.narrow(1, k * t, n) for k in range(4)))

    apart = second - first
    grid = math.gcd(step, apart)  # the lobes of dxy are not always whole samples apart
    u, c, t = step // grid, apart // grid, lobe // grid
    rows, cols = (n - 1) * u + 1, (m - 1) * u + 1
    high, wide = rows + c, cols + c + t
    band = corners(first + lobe, first, high, wide, grid) - corners(first, first, high, wide, grid)
    band = band[:, :rows:u] - band[:, c::u]
    band = band[..., t:] - band[..., :-t]
    dxy = (band[..., :cols:u] - band[..., c::u]).float()

    area = lobe * (far - near)
    dxx.mul_(dyy).addcmul_(dxy, dxy, value=-((0.9 * area / lobe**2) ** 2))
    torch.mul(dxx, area**-2, out=out)


def _lobes(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """Float sum over three adjoining lobes, weighted 1, -2, 1, from the integrals at their four edges."""
    middle = c - b
    return torch.add(d, middle, alpha=-3, out=middle).sub_(a).float()


@lru_cache(maxsize=4)
def _boxes(device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """The filters of all layers, as eight boxes: two of dxx (whole, middle lobe), two of dyy, four of dxy.

    Returns:
        (2, 4, 8, 20) int32: y and x of the four corners of the boxes; (3, 20) float32 areas of dxx, dyy
        and dxy; (20,) sizes.
    """
    boxes, areas, sizes = [], [], []
    for octave, layer in product(range(OCTAVES), range(LAYERS)):
        size = _size(octave, layer)
        lobe, near, far, first, second = _edges(size)
        long, whole, middle = (near, far), (0, size), (lobe, 2 * lobe)
        diagonal = [(k, k + lobe) for k in (first, second)]
        spans = [(long, whole), (long, middle), (whole, long), (middle, long), *product(diagonal, diagonal)]
        boxes.append([[*product(ys, xs)] for ys, xs in spans])
        areas.append((lobe * (far - near), lobe * (far - near), lobe**2 / 0.9))
        sizes.append(size)
    corners = torch.tensor(boxes, dtype=torch.int32).permute(3, 2, 1, 0).contiguous()
    return corners.to(device), torch.tensor(areas, device=device).T, torch.tensor(sizes, device=device)


def _refine(integral: Tensor, layer: Tensor, row: Tensor, col: Tensor) -> tuple[Tensor, ...]:
    """Check candidates (B, K) against all 26 neighbours, and move them to the top of the quadric they form.

    Returns:
        keep (B, K) bool: strict maxima whose quadric has its top within a sample; x, y (sub-pixel) and
        size (sub-scale, rounded to pixels).
    """
    plane, line, _ = integral.stride()
    corners, areas, sizes = _boxes(integral.device)
    image = torch.arange(len(layer), device=layer.device).repeat_interleave(layer.shape[1])
    shape, (layer, row, col) = layer.shape, (c.flatten() for c in (layer, row, col))
    near = torch.arange(-1, 2, device=layer.device)[:, None]
    step = 1 << torch.div(layer, LAYERS, rounding_mode="floor")
    layers = layer + near  # (3, K)
    margin = _margin(layers % LAYERS)[:, None]
    y, x = (row + near - margin) * step, (col + near - margin) * step  # (3, 3, K): scale, place
    base = ((y * line + image * plane)[:, :, None] + x[:, None]).int()
    offset = (corners[0] * line + corners[1]).flatten(0, 1).index_select(1, layers.flatten())
    index = base[:, :, :, None] + offset.view(32, 3, -1).transpose(0, 1)[:, None, None]  # (3, 3, 3, 32, K)
    sums = integral.view(-1).index_select(0, index.view(-1)).view(3, 3, 3, 4, 8, -1)
    box = (sums[..., 3, :, :] - sums[..., 2, :, :]).sub_(sums[..., 1, :, :]).add_(sums[..., 0, :, :])
    dxx, dyy = (box[..., i, :].sub(box[..., i + 1, :], alpha=3) / areas[0, layers][:, None, None] for i in (0, 2))
    dxy = (box[..., 4, :] - box[..., 5, :] - box[..., 6, :] + box[..., 7, :]) / areas[2, layers][:, None, None]
    det = dxx * dyy - dxy * dxy  # (3, 3, 3, K): scale, row, column

    offset, inside = _top(det)
    strict = (det.view(27, -1) < det[1, 1, 1]).sum(0) == 26
    size = sizes[layer]
    corner = (size - 1) / 2
    x = x[1, 1] + corner + offset[0] * step
    y = y[1, 1] + corner + offset[1] * step
    size = torch.round(size + offset[2] * 6 * step)
    return tuple(column.view(shape) for column in (strict & inside, x, y, size))


def _top(d: Tensor) -> tuple[Tensor, Tensor]:
    """Top of the quadric through (3, 3, 3, K) samples: (3, K) offsets in x, y, scale; (K,) within a sample?"""
    plus, minus = (torch.stack([d[1, 1, e], d[1, e, 1], d[e, 1, 1]]) for e in (2, 0))
    gradient = (plus - minus) / 2
    dxx, dyy, dss = plus - 2 * d[1, 1, 1] + minus
    dxy = (d[1, 2, 2] - d[1, 2, 0] - d[1, 0, 2] + d[1, 0, 0]) / 4
    dxs = (d[2, 1, 2] - d[2, 1, 0] - d[0, 1, 2] + d[0, 1, 0]) / 4
    dys = (d[2, 2, 1] - d[2, 0, 1] - d[0, 2, 1] + d[0, 0, 1]) / 4
    a, b, c = (torch.stack(column) for column in ((dxx, dxy, dxs), (dxy, dyy, dys), (dxs, dys, dss)))
    adjugate = torch.stack([b.cross(c, dim=0), c.cross(a, dim=0), a.cross(b, dim=0)])
    offset = -(adjugate * gradient).sum(1) / (a * adjugate[0]).sum(0)
    return offset, (offset.abs() <= 1).all(0)
