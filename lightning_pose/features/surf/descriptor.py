"""SURF's orientation and descriptor: Haar wavelet responses around each keypoint, from integral images.

Bay, Ess, Tuytelaars, Van Gool: "Speeded-Up Robust Features", 2008, section 4. Windows, weights, angles and
the order of the 64 numbers are OpenCV's: 4 x 4 fields, across the keypoint's angle and then along it, each with
the sums of dx, dy, |dx|, |dy|, where dx is the response along the angle and dy a quarter turn further. Angles
run clockwise from the x axis; an upright keypoint's is 270 degrees, up.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

__all__ = ["UPRIGHT_ANGLE", "compute_descriptors", "compute_orientations"]

UPRIGHT_ANGLE = 270.0
"""Angle in degrees of keypoints whose orientation is not computed."""

CHUNK = 150
"""Keypoints whose windows are read at once on a CPU: as many as fit its cache."""

CELLS = 21
"""Cells along a side of the window; each of the 20 x 20 samples is the Haar response of 2 x 2 cells."""


def compute_descriptors(
    integral: Tensor, image: Tensor, xy: Tensor, size: Tensor, angle: Tensor | None = None
) -> Tensor:
    """Compute descriptors (K, 64), L2-normalised.

    Args:
        integral: (B, H + 1, W + 1) int32 integral images.
        image: (K,) int64, the image of each keypoint.
        xy: (K, 2) float32, pixels.
        size: (K,) float32, whole pixels; a keypoint of size 0 gets a zero row.
        angle: (K,) float32, degrees; None for upright windows.
    """
    window = torch.div(size * 14, 5, rounding_mode="floor")  # 21 * 1.2 / 9 of the size, without rounding errors
    columns = [image, xy, window, *([] if angle is None else [torch.deg2rad(angle)])]
    sample = _sample_upright_patch if angle is None else _sample_rotated_patch
    parts = zip(*(c.split(CHUNK if c.device.type == "cpu" else max(len(c), 1)) for c in columns), strict=True)
    patch = torch.cat([sample(integral, *part) for part in parts], 2)
    filters = _make_filters(integral.device)
    smooth, change = (filters @ patch.flatten(1)).view(2, CELLS - 1, CELLS, -1)
    dx, dy = filters[CELLS - 1 :] @ smooth, filters[: CELLS - 1] @ change
    responses = torch.stack([dx, dy, dx.abs(), dy.abs()], 2)  # (across, along, 4, K)
    fields = responses.unflatten(1, (4, 5)).sum(2).unflatten(0, (4, 5)).sum(1)
    return normalize(fields.flatten(0, 2).T)


def compute_orientations(integral: Tensor, image: Tensor, xy: Tensor, size: Tensor) -> Tensor:
    """Compute dominant gradient directions (K,), degrees in 0..360: the strongest 60-degree sector of a disc.

    Arguments are as for `compute_descriptors`. Samples whose wavelet leaves the image are left out.
    """
    disc, weight = _make_disc(integral.device)
    scale = size * (1.2 / 9)
    half = torch.round(2 * scale)  # half the wavelet's side
    corner = torch.round(xy.T[:, None] + disc[..., None] * scale - (half - 0.5))  # (2, 113, K)
    limit = torch.tensor([integral.shape[2], integral.shape[1]], device=xy.device).view(2, 1, 1) - 2 * half
    inside = ((corner >= 0) & (corner < limit)).all(0)
    x, y = (corner * inside)[:, None] + half * torch.arange(3, device=xy.device).view(3, 1, 1)
    sums = _sample_integral(integral, image.repeat(len(weight)), y.flatten(1), x.flatten(1)).unflatten(2, inside.shape)
    dx = _compute_second_difference(sums[2] - sums[0]) * weight[:, None] * inside
    dy = _compute_second_difference(sums[:, 2] - sums[:, 0]) * weight[:, None] * inside

    degree = torch.round(torch.rad2deg(torch.atan2(dy, dx))).long() % 360
    histogram = dx.new_zeros((2, 360, len(xy))).scatter_add_(1, degree.expand(2, -1, -1), torch.stack([dx, dy]))
    around = torch.cat([histogram[:, -29:], histogram, histogram[:, :29]], 1)
    around = pad(around.cumsum(1), (0, 0, 1, 0))
    sectors = (around[:, 59:] - around[:, :-59])[:, ::5]  # every 5 degrees, 29 to each side
    best = sectors.square().sum(0).argmax(0)
    x, y = sectors.gather(1, best.expand(2, 1, -1)).squeeze(1)
    return torch.rad2deg(torch.atan2(y, x)) % 360


def _compute_second_difference(a: Tensor) -> Tensor:
    """Second difference of three neighbours along the first axis."""
    return a[0] - 2 * a[1] + a[2]


def _sample_upright_patch(integral: Tensor, image: Tensor, xy: Tensor, window: Tensor) -> Tensor:
    """Grey sums of cells (21, 21, K), to the right and upwards, with cells on whole pixels as OpenCV has them."""
    x, y = xy.unbind(1)
    half = (window - 1) / 2
    edge = torch.arange(CELLS + 1, device=xy.device)[:, None] * (window / CELLS)
    sums = _sample_integral(integral, image, torch.round(y + half) + 1 - edge, torch.round(x - half) + edge)
    columns = sums[:-1] - sums[1:]
    return (columns[:, 1:] - columns[:, :-1]).transpose(0, 1)


def _sample_rotated_patch(integral: Tensor, image: Tensor, xy: Tensor, window: Tensor, angle: Tensor) -> Tensor:
    """Grey sums (21, 21, K) around the centres of rotated cells, across and along the angle.

    The cells themselves are parallel to the image's axes, as integral images need them.
    """
    cell = window / CELLS
    along = (torch.arange(CELLS, device=xy.device) - CELLS // 2)[:, None] * cell
    u, v, cos, sin = along[:, None], along, torch.cos(angle), torch.sin(angle)
    edges = torch.stack([-cell, cell])[:, None, None] / 2 + 0.5
    x = edges + (xy[:, 0] + v * cos - u * sin)
    y = edges + (xy[:, 1] + v * sin + u * cos)
    sums = _sample_integral(integral, image.repeat(CELLS * CELLS), y.flatten(1), x.flatten(1))
    return (sums[1, 1] - sums[0, 1] - sums[1, 0] + sums[0, 0]).view(CELLS, CELLS, -1)


def _sample_integral(integral: Tensor, image: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """Integrals (R, C, K) at R fractional rows and C columns of each of K places, up to terms of one axis.

    Terms that depend on the row alone or the column alone cancel in every box sum; without them the numbers are small
    enough for float32. Outside the image the border pixels are repeated.
    """
    plane, line, _ = integral.stride()
    rows, down = _find_lattice_cells(y, integral.shape[1])
    cols, across = _find_lattice_cells(x, integral.shape[2])
    index = (rows * line + (image * plane).int())[:, None] + cols
    sums = integral.view(-1).index_select(0, index.view(-1)).view(index.shape)
    sums = (sums - sums[:1]).sub_(sums[:, :1] - sums[:1, :1]).float()
    sums = torch.lerp(sums[: len(y)], sums[len(y) :], down[:, None])
    return torch.lerp(sums[:, : len(x)], sums[:, len(x) :], across)


def _find_lattice_cells(position: Tensor, length: int) -> tuple[Tensor, Tensor]:
    """Whole numbers (2 * E, K) int32 below and above each position, and the fraction (E, K) between them.

    Beyond the ends the two last numbers are used with a fraction outside 0..1: linear extrapolation.
    """
    below = position.floor().clamp_(0, length - 2)
    cell = below.int()
    return torch.cat([cell, cell + 1]), position - below


@lru_cache(maxsize=4)
def _make_filters(device: torch.device) -> Tensor:
    """Filters (40, 21): Gaussian-weighted, 20 sums of two neighbouring cells, then 20 differences between them."""
    cells = torch.eye(CELLS)
    i = torch.arange(CELLS - 1) - (CELLS - 2) / 2
    weight = torch.exp(-(i**2) / (2 * 3.3**2))[:, None]
    return torch.cat([weight * (cells[1:] + cells[:-1]), weight * (cells[1:] - cells[:-1])]).to(device)


@lru_cache(maxsize=4)
def _make_disc(device: torch.device) -> tuple[Tensor, Tensor]:
    """Points (2, 113) with whole x, y within a radius of 6, and their Gaussian weights (113,)."""
    points = torch.cartesian_prod(*[torch.arange(-6, 7)] * 2).T
    square = points.square().sum(0)
    points, square = points[:, square <= 36], square[square <= 36]
    return points.to(device), torch.exp(-square / (2 * 2.5**2)).to(device)
