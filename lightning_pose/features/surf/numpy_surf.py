"""SURF in numpy, for one image at a time, where torch is missing or takes longer to import than the work.

The same features as `extractor` computes in torch, up to rounding.

Bay, Ess, Tuytelaars, Van Gool: "Speeded-Up Robust Features", 2008, with OpenCV's filters, borders and rounding:
4 octaves of 5 layers, octave o sampled every 2**o pixels.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import cv2
import numpy as np

from lightning_pose.features.surf.numpy_descriptor import UPRIGHT_ANGLE, compute_orientations, describe_surf

__all__ = ["extract_surf"]

OCTAVES, LAYERS = 4, 5

LOW = 10
"""First sample of each octave that can be a neighbour of a maximum; planes of determinants start here."""


class Detections(NamedTuple):
    """The strongest features, strongest first: xy (K, 2) in pixels, filter sizes (K,) in pixels, determinants (K,)."""

    xy: np.ndarray
    size: np.ndarray
    response: np.ndarray


class Candidates(NamedTuple):
    """Samples that no neighbour in layers 1 to 3 exceeds: place in planes, octave, layer, row, column; (K,) each."""

    at: np.ndarray
    octave: np.ndarray
    layer: np.ndarray
    row: np.ndarray
    col: np.ndarray


def extract_surf(gray: np.ndarray, n: int, upright: bool, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """The n strongest features of a (H, W) uint8 image whose determinant is above the threshold.

    Returns:
        keypoints (K, 5) float32: x, y, size (pixels), response, angle (degrees); descriptors (K, 64) float32 of unit
        length; K is at most n.
    """
    integral = cv2.integral(gray)
    found = detect_surf(integral, n, threshold)
    angle = np.full(len(found.size), UPRIGHT_ANGLE, np.float32)
    if not upright and len(angle):
        angle = compute_orientations(integral, found.xy, found.size)
    keypoints = np.column_stack([found.xy, found.size, found.response, angle]).astype(np.float32)
    return keypoints, describe_surf(integral, found.xy, found.size, None if upright else angle)


def detect_surf(integral: np.ndarray, n: int, threshold: float) -> Detections:
    """The n strongest maxima of the determinant over position and scale; `integral` is (H + 1, W + 1) int32."""
    height, width = integral.shape
    shapes = [[max((side - 1 >> octave) - 2 * LOW, 0) for side in (height, width)] for octave in range(OCTAVES)]
    ends = np.cumsum([h * w for h, w in shapes])
    planes = np.zeros((3, ends[-1]), np.float32)
    starts, found = np.concatenate([[0], ends[:-1]]), []
    for octave, ((h, w), start) in enumerate(zip(shapes, starts, strict=True)):
        if h * w:
            det = planes[:, start : start + h * w].reshape(3, h, w)
            row, col, layer = find_maxima(integral, det, octave, threshold)
            numbers = np.broadcast_to(octave, len(row))
            found.append(Candidates(start + row * w + col, numbers, layer + 1, row + LOW, col + LOW))
    if not found:
        return Detections(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    candidates = Candidates(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
    score = planes[candidates.layer - 1, candidates.at]
    ranking = np.argsort(-score, kind="stable")
    # Refining takes longer than sorting, and keeps about two thirds: from the strongest down, until there are n.
    widths, kept, enough = np.array([w for _, w in shapes]), [], max(2 * n, 600)
    for first in range(0, len(ranking), enough):
        chosen = ranking[first : first + enough]
        keep, *place = refine_candidates(integral, planes, widths, Candidates(*(part[chosen] for part in candidates)))
        kept.append(np.stack([*place, score[chosen]], axis=1)[keep & (score[chosen] > 0)])
        if sum(map(len, kept)) >= n:
            break
    x, y, size, response = np.concatenate([np.zeros((0, 4), np.float32), *kept])[:n].T
    return Detections(np.column_stack([x, y]), size, response)


def find_maxima(
    integral: np.ndarray, det: np.ndarray, octave: int, threshold: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Write the determinants of layers 1 to 3 of an octave into `det` (3, h, w), and find maxima over these layers.

    Returns:
        row, column and layer - 1 of samples above the threshold that no neighbour exceeds, (K,) each.
    """
    _, h, w = det.shape
    for layer, plane in enumerate(det, 1):
        inset = max(0, 3 * layer - 6)  # the filters of layer 3 do not fit around the outer samples
        inner = plane[inset : h - inset, inset : w - inset]
        if inner.size:
            compute_determinants(integral, octave, layer, LOW + inset, inner)
    lower, upper = np.maximum(det[0], det[1]), np.maximum(det[1], det[2])
    peaks, square = np.zeros((h, w, 3), bool), np.ones((3, 3), np.uint8)
    for k, highest in enumerate((lower, np.maximum(lower, det[2]), upper)):
        inset = 3 * k + 1  # one sample more than the filters of the layer above need
        if min(h, w) > 2 * inset:
            inner = np.s_[inset : h - inset, inset : w - inset]
            own = det[k][inner]
            peaks[(*inner, k)] = (own >= cv2.dilate(highest, square)[inner]) & (own > np.float32(threshold))
    at = np.flatnonzero(peaks)
    return at // (3 * w), at // 3 % w, at % 3


def find_lobe_edges(size: int) -> tuple[int, int, int, int, int]:
    """In a filter of this size: a lobe's width; first and last edge of its long side; edges of the diagonal lobes."""
    near, far, first, second = (round(size * ninths / 9) for ninths in (2, 7, 1, 5))
    return size // 3, near, far, first, second


def compute_determinants(integral: np.ndarray, octave: int, layer: int, first: int, out: np.ndarray) -> None:
    """Write a layer's determinants at the (n, m) samples from (first, first) on into `out`.

    Box sums are differences of shifted planes, which many boxes share.
    """
    step, start = 1 << octave, (first - 4 - 3 * layer) << octave
    size = (9 + 6 * layer) << octave
    lobe, near, far, first_lobe, second_lobe = find_lobe_edges(size)
    (n, m), t, at = out.shape, lobe // step, integral[start:, start:]

    def change(y0: int, x0: int, y1: int, x1: int, rows: int, cols: int, step: int = step) -> np.ndarray:
        low, high = (at[y : y + rows * step : step, x : x + cols * step : step] for y, x in ((y0, x0), (y1, x1)))
        return high - low

    def sum_lobes(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
        middle = b - c
        middle *= 3
        middle += d
        middle -= a
        return middle.astype(np.float32)

    band = change(near, 0, far, 0, n, m + 3 * t)
    dxx = sum_lobes(*(band[:, k * t : k * t + m] for k in range(4)))
    band = change(0, near, 0, far, n + 3 * t, m)
    dxx *= sum_lobes(*(band[k * t : k * t + n] for k in range(4)))
    apart = second_lobe - first_lobe
    grid = math.gcd(step, apart)  # the lobes of dxy are not always whole samples apart
    u, c, t = step // grid, apart // grid, lobe // grid
    rows, cols = (n - 1) * u + 1, (m - 1) * u + 1
    band = change(first_lobe, first_lobe, first_lobe + lobe, first_lobe, rows + c, cols + c + t, grid)
    band = band[:rows:u] - band[c::u]
    band = band[:, t:] - band[:, :-t]
    dxy = (band[:, :cols:u] - band[:, c::u]).astype(np.float32)
    area = lobe * (far - near)
    scaled = dxy * np.float32(-((0.9 * area / lobe**2) ** 2))
    scaled *= dxy
    dxx += scaled
    np.multiply(dxx, np.float32(area**-2), out=out)


def compute_determinants_at(integral: np.ndarray, found: Candidates, layer: np.ndarray) -> np.ndarray:
    """Determinants (3, 3, K), by row and column, at and around each candidate, in other layers than its own."""
    line, (corners, areas) = integral.shape[1], make_boxes()
    layer_id = found.octave * LAYERS + layer
    near = np.arange(-1, 2)[:, None] - 4 - 3 * layer
    y, x = (found.row + near) << found.octave, (found.col + near) << found.octave
    offset = (corners[0] * line + corners[1])[:, layer_id]
    index = ((y * line)[:, None] + x)[:, :, None] + offset  # (3, 3, 32, K)
    sums = integral.reshape(-1)[index].reshape(3, 3, 4, 8, -1)
    box = (sums[:, :, 3] - sums[:, :, 2] - sums[:, :, 1] + sums[:, :, 0]).astype(np.float32)
    area = areas[:, layer_id]
    dxx, dyy = ((box[:, :, i] - 3 * box[:, :, i + 1]) / area[0] for i in (0, 2))
    dxy = (box[:, :, 4] - box[:, :, 5] - box[:, :, 6] + box[:, :, 7]) / area[1]
    return dxx * dyy - dxy * dxy


@lru_cache(maxsize=1)
def make_boxes() -> tuple[np.ndarray, np.ndarray]:
    """The filters of all layers (octave * LAYERS + layer) as eight boxes each: two of dxx, two of dyy, four of dxy.

    Returns:
        (2, 32, 20): y and x of the boxes' corners, corner by corner; (2, 20): areas of dxx and dyy, and of dxy.
    """
    boxes, areas = [], []
    for octave, layer in product(range(OCTAVES), range(LAYERS)):
        size = (9 + 6 * layer) << octave
        lobe, near, far, first, second = find_lobe_edges(size)
        long, whole, middle = (near, far), (0, size), (lobe, 2 * lobe)
        diagonal = [(k, k + lobe) for k in (first, second)]
        spans = [(long, whole), (long, middle), (whole, long), (middle, long), *product(diagonal, diagonal)]
        boxes.append([[*product(ys, xs)] for ys, xs in spans])
        areas.append((lobe * (far - near), lobe**2 / 0.9))
    return np.array(boxes).transpose(3, 2, 1, 0).reshape(2, 32, -1), np.array(areas, np.float32).T


def refine_candidates(
    integral: np.ndarray, planes: np.ndarray, widths: np.ndarray, found: Candidates
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Compare K candidates with all 26 neighbours, and move them to the maximum of the quadric through these.

    Returns:
        (K,) bool, strict maxima whose quadric has its maximum within one sample; x, y and size in pixels, (K,) each.
    """
    near = np.arange(-1, 2)
    at = found.at + near.reshape(3, 1, 1) * widths[found.octave] + near.reshape(3, 1)  # (3, 3, K): row, column
    plane = np.clip(found.layer - 1 + near[:, None], 0, 2)
    d = planes[plane[:, None, None], at]  # (3, 3, 3, K): layer, row, column
    highest = found.layer == 3
    outer = compute_determinants_at(integral, found, 4 * highest)  # layer 0 or 4, which has no plane
    d[0] = np.where(found.layer == 1, outer, d[0])
    d[2] = np.where(highest, outer, d[2])
    offset = find_top(d)
    inside = (np.abs(offset) <= 1).all(axis=0)
    strict = (d.reshape(27, -1) < d[1, 1, 1]).sum(axis=0) == 26
    step = (1 << found.octave).astype(np.float32)
    size = ((9 + 6 * found.layer) << found.octave).astype(np.float32)
    # In float32 throughout, as torch has it: a rounding apart, and a descriptor's window moves by a pixel.
    x, y = (
        ((place - 4 - 3 * found.layer).astype(np.float32) + shift) * step + (size - 1) / 2
        for place, shift in ((found.col, offset[0]), (found.row, offset[1]))
    )
    return strict & inside, x, y, np.round(size + offset[2] * 6 * step)


def find_top(d: np.ndarray) -> np.ndarray:
    """Offsets (3, K), in x, y and scale, of the maximum of the quadric through samples (3, 3, 3, K)."""
    plus, minus = (np.stack([d[1, 1, e], d[1, e, 1], d[e, 1, 1]]) for e in (2, 0))
    gradient = (plus - minus) / 2
    dxx, dyy, dss = plus - 2 * d[1, 1, 1] + minus
    dxy = (d[1, 2, 2] - d[1, 2, 0] - d[1, 0, 2] + d[1, 0, 0]) / 4
    dxs = (d[2, 1, 2] - d[2, 1, 0] - d[0, 1, 2] + d[0, 1, 0]) / 4
    dys = (d[2, 2, 1] - d[2, 0, 1] - d[0, 2, 1] + d[0, 0, 1]) / 4
    a, b, c = (np.stack(column) for column in ((dxx, dxy, dxs), (dxy, dyy, dys), (dxs, dys, dss)))
    adjugate = np.stack([np.cross(p, q, axis=0) for p, q in ((b, c), (c, a), (a, b))])
    with np.errstate(divide="ignore", invalid="ignore"):
        return -(adjugate * gradient).sum(axis=1) / (a * adjugate[0]).sum(axis=0)
