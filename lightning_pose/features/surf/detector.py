"""SURF's detector: the strongest maxima of the Hessian's determinant over position and scale.

Bay, Ess, Tuytelaars, Van Gool: "Speeded-Up Robust Features", 2008, section 3.3, with OpenCV's borders and
rounding. A pixel's centre has integer coordinates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from lightning_pose.features.surf.hessian import (
    OCTAVES,
    compute_determinants,
    compute_determinants_at,
    compute_filter_size,
    compute_margin,
    view_head,
)

__all__ = ["Detections", "detect_keypoints"]

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
        bits: (S,) float32, bit k set at a candidate of layer k + 1.
        grids: (3, OCTAVES) int64: height, width, and start of each octave in S.
    """

    det: Tensor
    bits: Tensor
    grids: Tensor


class _Candidates(NamedTuple):
    """Samples that no neighbour in layers 1 to 3 exceeds: index into `_Planes`, octave, layer, image, row, column."""

    at: Tensor
    octave: Tensor
    layer: Tensor
    image: Tensor
    row: Tensor
    col: Tensor

    def pick(self, which: Tensor) -> _Candidates:
        """The candidates at these indices."""
        return _Candidates(*(column[which] for column in self))


def detect_keypoints(integral: Tensor, n: int, threshold: float) -> Detections:
    """Find the n strongest features of each image whose determinant is above the threshold.

    Args:
        integral: (B, H + 1, W + 1) int32 integral images.
        n: rows to return per image.
        threshold: determinants must be larger than this; OpenCV's hessianThreshold.
    """
    planes = _compute_planes(integral, threshold)
    candidates, score = _list_candidates(planes, len(integral))
    total = len(score)
    scores = score.new_zeros((len(integral), total))
    scores[candidates.image, torch.arange(total, device=score.device)] = score
    scores, ranking = scores.sort(dim=1, descending=True, stable=True)

    # Refining takes longer than sorting, and keeps about two thirds: candidates are refined from the strongest down,
    # until each image has n.
    found = []
    enough = max(2 * n, 600)
    for first in range(0, total, enough):
        response, pick = (t[:, first : first + enough] for t in (scores, ranking))
        keep, *place = (t.view_as(pick) for t in _refine_candidates(integral, planes, candidates.pick(pick.flatten())))
        keep &= response > 0
        found.append(torch.stack([keep, *place, response], -1).where(keep[..., None], 0))
        if torch.cat(found, 1)[..., 0].sum(1).min() >= n:
            break
    features = torch.cat([*found, score.new_zeros((len(integral), n, 5))], 1)
    strongest = features[..., 0].argsort(dim=1, descending=True, stable=True)[:, :n]
    features = features.gather(1, strongest[..., None].expand(-1, -1, 5))
    return Detections(features[..., 1:3], features[..., 3], features[..., 4], features[..., 0].sum(1).long())


def _compute_planes(integral: Tensor, threshold: float) -> _Planes:
    """Compute the determinants of layers 1 to 3 of all octaves, and mark candidates."""
    batch, height, width = integral.shape
    shapes = [[max((side - 1 >> octave) - 2 * LOW, 0) for side in (height, width)] for octave in range(OCTAVES)]
    ends = np.cumsum([batch * h * w for h, w in shapes]).tolist()
    block = torch.empty(4 * (ends[-1] + integral.numel()), device=integral.device)
    samples, scratch = block[: 4 * ends[-1]].view(4, -1), block[4 * ends[-1] :].view(4, -1)
    starts = [0, *ends[:-1]]
    for octave, ((h, w), start, end) in enumerate(zip(shapes, starts, ends, strict=True)):
        if start < end:
            *det, bits = samples[:, start:end].view(4, batch, h, w)
            det[2].zero_()  # the filters of layer 3 do not fit around the outer samples
            for layer, plane in enumerate(det, 1):
                inset = max(compute_margin(layer) - LOW, 0)
                inner = plane[:, inset : h - inset, inset : w - inset]
                if inner.numel():
                    compute_determinants(integral, octave, layer, LOW + inset, scratch, inner)
            _mark_maxima(det, threshold, scratch, bits.zero_())
    grids = torch.tensor([*zip(*shapes, strict=True), starts], device=integral.device)
    return _Planes(samples[:3], samples[3], grids)


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


def _list_candidates(planes: _Planes, batch: int) -> tuple[_Candidates, Tensor]:
    """List the marked samples, and their determinants."""
    marked = _find_nonzero(planes.bits)
    layer, entry = (planes.bits[marked].int() & marked.new_tensor([[1], [2], [4]])).nonzero().unbind(1)
    at = marked[entry]
    heights, widths, starts = planes.grids
    octave = torch.bucketize(at, starts + batch * heights * widths, right=True)
    height, width, start = planes.grids[:, octave]
    line = torch.div(at - start, width, rounding_mode="floor")
    image = torch.div(line, height, rounding_mode="floor")
    row, col = line - image * height + LOW, at - start - line * width + LOW
    return _Candidates(at, octave, layer + 1, image, row, col), planes.det[layer, at]


def _find_nonzero(values: Tensor) -> Tensor:
    """Indices of values (S,) that are not zero; eight are tested at a time, because few are not zero."""
    flags = pad(values.bool(), (0, -len(values) % 8))
    words = flags.view(torch.int64).nonzero().squeeze(1)
    word, byte = flags.view(-1, 8)[words].nonzero().unbind(1)
    return words[word] * 8 + byte


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
    det = planes.det[plane[:, None, None], at]  # (3, 3, 3, K): layer, row, column
    lowest, highest = found.layer == 1, found.layer == 3
    outer = compute_determinants_at(
        integral, found.octave, 4 * highest.long(), found.image, found.row, found.col
    )  # layer 0 or 4, which `_Planes` does not hold
    det[0] = torch.where(lowest, outer, det[0])
    det[2] = torch.where(highest, outer, det[2])

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
