"""SURF's detector: the strongest maxima of the Hessian's determinant over position and scale.

Bay, Ess, Tuytelaars, Van Gool: "Speeded-Up Robust Features", 2008, section 3.3, with OpenCV's borders and
rounding. A pixel's centre has integer coordinates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightning_pose.features.surf.hessian import (
    OCTAVES,
    compute_determinants,
    compute_determinants_at,
    compute_filter_size,
    compute_margin,
    view_head,
)
from lightning_pose.features.surf.strips import StripProgram, get_program

__all__ = ["Detections", "detect_keypoints", "find_maxima", "find_maxima_in_strips"]

LOW = compute_margin(2)
"""First sample of each octave that can be a neighbour of a maximum; planes of determinants start here."""


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


class _Planes(NamedTuple):
    """Determinants of layers 1, 2, 3 of all octaves, one octave after the other; an octave is (B, height, width).

    Attributes:
        det: (3, S) float32 determinants.
        grids: (3, OCTAVES) int64: height, width, and start of each octave in S.
    """

    det: Tensor
    grids: Tensor


class _Candidates(NamedTuple):
    """Samples that no neighbour in layers 1 to 3 exceeds: index into `_Planes`, octave, layer, image, row, column."""

    at: Tensor
    octave: Tensor
    layer: Tensor
    image: Tensor
    row: Tensor
    col: Tensor


def detect_keypoints(integral: Tensor, n: int, threshold: float) -> Detections:
    """Find the n strongest features of each image whose determinant is above the threshold.

    Args:
        integral: (B, H + 1, W + 1) int32 integral images.
        n: rows to return per image.
        threshold: determinants must be larger than this; OpenCV's hessianThreshold.
    """
    if integral.device.type != "cpu" or not len(integral):
        return _refine_strongest(integral, *find_maxima(integral, threshold), n)
    found = [_refine_strongest(image[None], *find_maxima_in_strips(image, threshold), n) for image in integral]
    return Detections(*(torch.cat(column) for column in zip(*found, strict=True)))


def _refine_strongest(
    integral: Tensor, planes: _Planes, layer: Tensor, at: Tensor, scores: Tensor, n: int
) -> Detections:
    """The n strongest features of each image among candidates.

    Args:
        integral: (B, H + 1, W + 1) int32.
        planes: of these images.
        layer: (B, C) int64, candidates by falling score.
        at: (B, C) int64, index into `planes`.
        scores: (B, C) float32, the determinants; 0 for no candidate.
        n: rows to return per image.
    """
    # Refining takes longer than sorting, and keeps about two thirds: candidates are refined from the strongest down,
    # until each image has n.
    found = []
    enough = max(2 * n, 600)
    for first in range(0, scores.shape[1], enough):
        response, *which = (t[:, first : first + enough] for t in (scores, layer, at))
        candidates = _locate(planes, len(integral), *(t.flatten() for t in which))
        keep, *place = (t.view_as(response) for t in _refine_candidates(integral, planes, candidates))
        keep &= response > 0
        found.append(torch.stack([keep, *place, response], -1).where(keep[..., None], 0))
        if torch.cat(found, 1)[..., 0].sum(1).min() >= n:
            break
    features = torch.cat([*found, scores.new_zeros((len(integral), n, 5))], 1)
    strongest = features[..., 0].argsort(dim=1, descending=True, stable=True)[:, :n]
    features = features.gather(1, strongest[..., None].expand(-1, -1, 5))
    return Detections(features[..., 1:3], features[..., 3], features[..., 4], features[..., 0].sum(1).long())


def _locate(planes: _Planes, batch: int, layer: Tensor, at: Tensor) -> _Candidates:
    """Octave, image, row and column of candidates."""
    heights, widths, starts = planes.grids
    octave = torch.bucketize(at, starts + batch * heights * widths, right=True)
    height, width, start = planes.grids[:, octave]
    line = torch.div(at - start, width, rounding_mode="floor")
    image = torch.div(line, height, rounding_mode="floor")
    row, col = line - image * height + LOW, at - start - line * width + LOW
    return _Candidates(at, octave, layer, image, row, col)


def _allocate_planes(integral: Tensor) -> tuple[_Planes, list[Tensor]]:
    """Planes for the octaves, and each octave's part of them, (3, B, height, width)."""
    batch, *sides = integral.shape
    shapes = [[max((side - 1 >> octave) - 2 * LOW, 0) for side in sides] for octave in range(OCTAVES)]
    sizes = [batch * h * w for h, w in shapes]
    det = torch.empty((3, sum(sizes)), device=integral.device)
    starts = np.cumsum([0, *sizes[:-1]]).tolist()
    octaves = [part.view(3, batch, h, w) for part, (h, w) in zip(det.split(sizes, 1), shapes, strict=True)]
    return _Planes(det, torch.tensor([*zip(*shapes, strict=True), starts], device=integral.device)), octaves


def find_maxima_in_strips(integral: Tensor, threshold: float) -> tuple[_Planes, Tensor, Tensor, Tensor]:
    """The maxima of one image (H + 1, W + 1), on a CPU: planes, and layer, place and determinant (1, C), by size."""

    height, width = integral.shape

    def make() -> tuple[_Planes, StripProgram, list[int]]:
        planes, octaves = _allocate_planes(integral[None])
        sizes = [max(octave[0].numel(), 1) for octave in octaves]
        return planes, StripProgram(height, width, [octave[:, 0] for octave in octaves], LOW), sizes

    planes, program, sizes = get_program(height, width, make)
    found = program.run(integral.numpy())
    keys = [
        (place % size + start) * 4 + place // size
        for place, size, start in zip(found, sizes, planes.grids[2].tolist(), strict=True)
    ]
    key = np.concatenate(keys)
    scores = planes.det.numpy()[key % 4, key // 4]
    key, scores = key[scores > threshold], scores[scores > threshold]
    # One sort of whole numbers: positive floats are in the order of their bits, and equal ones in that of their places.
    key = np.sort((0x7FFFFFFF - scores.view(np.int32)).astype(np.int64) << 32 | key) & 0xFFFFFFFF
    layer, at = (torch.from_numpy(column)[None] for column in (key % 4, key // 4))
    return planes, layer + 1, at, planes.det[layer, at]


def find_maxima(integral: Tensor, threshold: float) -> tuple[_Planes, Tensor, Tensor, Tensor]:
    """The maxima of images (B, H + 1, W + 1), on any device: as `find_maxima_in_strips`, with a row (C) each."""
    batch = len(integral)
    planes, octaves = _allocate_planes(integral)
    scratch = torch.empty((4, integral.numel()), device=integral.device)
    bits = torch.zeros(planes.det.shape[1], device=integral.device)
    parts = bits.split([octave[0].numel() for octave in octaves])
    for octave, (det, part) in enumerate(zip(octaves, parts, strict=True)):
        h, w = det.shape[2:]
        if not det.numel():
            continue
        det[2].zero_()  # the filters of layer 3 do not fit around the outer samples
        for layer, plane in enumerate(det, 1):
            inset = max(compute_margin(layer) - LOW, 0)
            inner = plane[:, inset : h - inset, inset : w - inset]
            if inner.numel():
                compute_determinants(integral, octave, layer, LOW + inset, scratch, inner)
        _mark_maxima([*det], threshold, scratch, part.view(batch, h, w))
    at, layer = (bits[:, None].int() & bits.new_tensor([1, 2, 4], dtype=torch.int32)).nonzero().unbind(1)
    score = planes.det[layer, at]
    scores = score.new_zeros((batch, len(score)))
    scores[_locate(planes, batch, layer, at).image, torch.arange(len(score), device=score.device)] = score
    scores, ranking = scores.sort(dim=1, descending=True, stable=True)
    return planes, (layer + 1)[ranking], at[ranking], scores


def _mark_maxima(det: list[Tensor], threshold: float, scratch: Tensor, bits: Tensor) -> None:
    """Set bit k of samples where layer k + 1 is above the threshold and no neighbour in these layers exceeds it.

    Comparisons in place, in float32, are several times faster than masks.
    """
    batch, h, w = bits.shape
    highest = view_head(scratch[0], batch, h, w)
    least = float(np.nextafter(np.float32(threshold), np.float32(np.inf)))

    def mark(k: int) -> None:
        inset = compute_margin(k + 2) + 1 - LOW  # one sample more than the filters of the layer above need
        n, m = h - 2 * inset, w - 2 * inset
        if min(n, m) < 1:
            return
        up, middle, down = (highest.narrow(1, inset + i, n) for i in (-1, 0, 1))
        lines = torch.maximum(up, down, out=view_head(scratch[1], batch, n, w))
        torch.maximum(lines, middle, out=lines)
        left, middle, right = (lines.narrow(2, inset + i, m) for i in (-1, 0, 1))
        peak = torch.maximum(left, right, out=view_head(scratch[2], batch, n, m))
        torch.maximum(peak, middle, out=peak)
        peak.clamp_(min=least).le_(det[k][:, inset : h - inset, inset : w - inset])
        bits[:, inset : h - inset, inset : w - inset].add_(peak, alpha=1 << k)

    torch.maximum(det[0], det[1], out=highest)
    mark(0)
    torch.maximum(highest, det[2], out=highest)
    mark(1)
    torch.maximum(det[1], det[2], out=highest)
    mark(2)


def _refine_candidates(integral: Tensor, planes: _Planes, found: _Candidates) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Compare K candidates with all 26 neighbours, and move them to the maximum of the quadric through these.

    Returns:
        keep (K,) bool: strict maxima whose quadric has its maximum within one sample; x, y (sub-pixel) and size
        (interpolated between scales, rounded to pixels).
    """
    near = torch.arange(-1, 2, device=integral.device)
    width = planes.grids[1, found.octave]
    at = found.at + near.view(3, 1, 1) * width + near.view(3, 1)  # (3, 3, K): row, column
    plane = (found.layer - 1 + near[:, None]).clamp(0, 2)  # (3, K)
    index = plane[:, None, None] * planes.det.shape[1] + at
    det = planes.det.view(-1).index_select(0, index.view(-1)).view(3, 3, 3, -1)  # layer, row, column
    outer = (found.layer != 2).nonzero().squeeze(1)  # next to layer 0 or 4, which `_Planes` does not hold
    layer, *place = (column[outer] for column in (found.layer, found.octave, found.image, found.row, found.col))
    det[layer - 1, :, :, outer] = compute_determinants_at(integral, place[0], 2 * layer - 2, *place[1:]).movedim(2, 0)

    offset, inside = _find_top(det)
    strict = (det.view(27, -1) < det[1, 1, 1]).sum(0) == 26
    step, size = 1 << found.octave, compute_filter_size(found.octave, found.layer)
    centre = (size - 1) / 2
    x, y = (
        (i - compute_margin(found.layer) + shift) * step + centre
        for i, shift in ((found.col, offset[0]), (found.row, offset[1]))
    )
    return strict & inside, x, y, torch.round(size + offset[2] * 6 * step)


def _find_top(d: Tensor) -> tuple[Tensor, Tensor]:
    """Fit a quadric to samples (3, 3, 3, K): layer, row, column.

    Returns:
        offsets (3, K) of its maximum in x, y and scale; (K,) bool, whether all three are within one sample.
    """
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
