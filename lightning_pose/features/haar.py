"""SURF's orientation and descriptor: Haar wavelet responses around each keypoint, out of integral images.

Bay, Ess, Tuytelaars, Van Gool: "Speeded-Up Robust Features", 2008, section 4. Windows, weights, angles and
the order of the 64 numbers are OpenCV's: a window's first axis runs along the keypoint's angle (clockwise
from the x axis; 270 degrees, up, for an upright keypoint), its second axis a quarter turn further.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

__all__ = ["UPRIGHT_ANGLE", "describe", "orientations"]

UPRIGHT_ANGLE = 270.0
"""Degrees; the angle of keypoints whose orientation is not looked for."""

CELLS = 21
"""Cells on a side of the window; each of the 20 x 20 samples is a Haar response of 2 x 2 of them."""


def describe(integral: Tensor, image: Tensor, xy: Tensor, size: Tensor, angle: Tensor | None = None) -> Tensor:
    """(K, 64) L2-normalised descriptors.

    Args:
        integral: (B, H + 1, W + 1) int32 integral images.
        image: (K,) int64, the image of each keypoint.
        xy: (K, 2) float32, pixels.
        size: (K,) float32, whole pixels; a keypoint of size 0 gets a zero row.
        angle: (K,) float32, degrees; None for upright windows.
    """
    window = torch.div(size * 14, 5, rounding_mode="floor")  # 21 * 1.2 / 9 of the size, free of rounding errors
    if angle is None:
        patch = _upright_patch(integral, image, xy, window)
    else:
        patch = _rotated_patch(integral, image, xy, window, torch.deg2rad(angle))
    smooth, change = _filters(integral.device)
    dx, dy = smooth @ patch @ change.T, change @ patch @ smooth.T
    responses = torch.stack([dx, dy, dx.abs(), dy.abs()], -1)
    return normalize(responses.unflatten(2, (4, 5)).unflatten(1, (4, 5)).sum((2, 4)).flatten(1))


def orientations(integral: Tensor, image: Tensor, xy: Tensor, size: Tensor) -> Tensor:
    """(K,) dominant gradient directions, degrees in 0..360: the strongest 60-degree sector of a disc.

    Args: as for `describe`. Samples whose wavelet leaves the image are left out.
    """
    disc, weight = _disc(integral.device)
    scale = size * (1.2 / 9)
    half = torch.round(2 * scale)  # half the wavelet's side
    corner = torch.round(xy[:, None] + disc * scale[:, None, None] - (half[:, None, None] - 0.5))  # (K, 113, 2)
    limit = torch.tensor([integral.shape[2], integral.shape[1]], device=xy.device) - 2 * half[:, None, None]
    inside = ((corner >= 0) & (corner < limit)).all(2)
    corner, side = (corner * inside[..., None]).flatten(0, 1), half.repeat_interleave(len(disc))
    steps = side[:, None] * torch.arange(3, device=xy.device)
    sums = _sums(integral, image.repeat_interleave(len(disc)), corner[:, 1:] + steps, corner[:, :1] + steps)
    bands = sums[:, 2] - sums[:, 0], sums[:, :, 2] - sums[:, :, 0]
    dx, dy = (b[:, 0] + b[:, 2] - 2 * b[:, 1] for b in bands)
    gradient = torch.stack([dx, dy], 1).view(len(xy), -1, 2) * (weight * inside)[..., None]

    degree = torch.round(torch.rad2deg(torch.atan2(gradient[..., 1], gradient[..., 0]))).long() % 360
    histogram = gradient.new_zeros((len(xy), 360, 2)).scatter_add_(1, degree[..., None].expand(-1, -1, 2), gradient)
    around = torch.cat([histogram[:, -29:], histogram, histogram[:, :29]], 1).cumsum(1)
    around = pad(around, (0, 0, 1, 0))
    sectors = (around[:, 59:] - around[:, :-59])[:, ::5]  # every 5 degrees, 29 to each side
    best = sectors.square().sum(2).argmax(1)
    x, y = sectors[torch.arange(len(xy), device=xy.device), best].unbind(1)
    return torch.rad2deg(torch.atan2(y, x)) % 360


def _upright_patch(integral: Tensor, image: Tensor, xy: Tensor, window: Tensor) -> Tensor:
    """(K, 21, 21) grey sums of cells: axis 1 to the right, axis 2 upwards, as OpenCV places whole pixels."""
    half = (window[:, None] - 1) / 2
    edge = window[:, None] / CELLS * torch.arange(CELLS + 1, device=xy.device)
    right = torch.round(xy[:, :1] - half) + edge
    up = torch.round(xy[:, 1:] + half) + 1 - edge
    sums = _sums(integral, image, up, right)
    columns = sums[:, :-1] - sums[:, 1:]
    return (columns[..., 1:] - columns[..., :-1]).transpose(1, 2)


def _rotated_patch(integral: Tensor, image: Tensor, xy: Tensor, window: Tensor, angle: Tensor) -> Tensor:
    """(K, 21, 21) grey sums around the centres of rotated cells.

    The cells themselves stay parallel to the image, so that integral images serve.
    """
    cell = window / CELLS
    along = (torch.arange(CELLS, device=xy.device) - CELLS // 2) * cell[:, None]
    cos, sin = torch.cos(angle)[:, None, None], torch.sin(angle)[:, None, None]
    u, v = along[:, :, None], along[:, None, :]
    centre = xy[:, None, None] + 0.5 + torch.stack([v * cos - u * sin, v * sin + u * cos], -1)  # (K, 21, 21, 2)
    half = cell[:, None, None, None] / 2
    box = torch.stack([centre - half, centre + half], -1).flatten(0, 2)
    sums = _sums(integral, image.repeat_interleave(CELLS * CELLS), box[:, 1], box[:, 0])
    return (sums[:, 1, 1] - sums[:, 0, 1] - sums[:, 1, 0] + sums[:, 0, 0]).view(-1, CELLS, CELLS)


def _sums(integral: Tensor, image: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """(K, R, C) integrals at R fractional rows and C columns of each of K places, up to terms of one axis.

    What depends on the row alone or on the column alone drops out of every box sum; without it the
    numbers are small enough for float32. Outside the image the border pixels are repeated.
    """
    rows, down = _lattice(y, integral.shape[1])
    cols, across = _lattice(x, integral.shape[2])
    index = (image[:, None] * integral.stride(0) + rows * integral.shape[2])[:, :, None] + cols[:, None]
    sums = integral.view(-1).index_select(0, index.view(-1)).view(index.shape)
    sums = (sums - sums[:, :1]).sub_(sums[:, :, :1] - sums[:, :1, :1]).float()
    n, m = y.shape[1], x.shape[1]
    sums = torch.lerp(sums[:, :n], sums[:, n:], down[:, :, None])
    return torch.lerp(sums[..., :m], sums[..., m:], across[:, None])


def _lattice(position: Tensor, length: int) -> tuple[Tensor, Tensor]:
    """Lattice neighbours (K, 2 * E) below and above each position, and the fraction (K, E) between them.

    Beyond the ends the neighbours stay and the fraction leaves 0..1: linear extrapolation.
    """
    below = position.floor().clamp_(0, length - 2)
    cell = below.long()
    return torch.cat([cell, cell + 1], 1), position - below


@lru_cache(maxsize=4)
def _filters(device: torch.device) -> tuple[Tensor, Tensor]:
    """(20, 21) Gaussian-weighted sums of two neighbouring cells, and changes between them."""
    cells = torch.eye(CELLS)
    i = torch.arange(CELLS - 1) - (CELLS - 2) / 2
    weight = torch.exp(-(i**2) / (2 * 3.3**2))[:, None]
    return (weight * (cells[1:] + cells[:-1])).to(device), (weight * (cells[1:] - cells[:-1])).to(device)


@lru_cache(maxsize=4)
def _disc(device: torch.device) -> tuple[Tensor, Tensor]:
    """The 113 lattice points (x, y) within a radius of 6, and their Gaussian weights."""
    i = torch.arange(-6, 7)
    points = torch.cartesian_prod(i, i)
    points = points[points.square().sum(1) <= 36].float()
    return points.to(device), torch.exp(-points.square().sum(1) / (2 * 2.5**2)).to(device)
