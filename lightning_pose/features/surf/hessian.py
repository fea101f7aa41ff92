"""SURF's filters: integral images, and the determinant of the Hessian from box sums, on grids and at single samples.

Bay, Ess, Tuytelaars, Van Gool: "Speeded-Up Robust Features", 2008, section 3.2. Filter sizes and sampling
are those of OpenCV: 4 octaves of 5 layers, octave o sampled every 2**o pixels. Sample (row,
column) of an octave is the centre of its filters, whatever their size.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import product
from typing import TypeVar

import cv2
import torch
from torch import Tensor

__all__ = [
    "LAYERS",
    "OCTAVES",
    "compute_determinants",
    "compute_determinants_at",
    "compute_filter_size",
    "compute_integral_image",
    "compute_margin",
    "find_lobe_edges",
    "scale_determinant",
    "view_head",
]

OCTAVES = 4
LAYERS = 5

Number = TypeVar("Number", int, Tensor)


def compute_integral_image(gray: Tensor) -> Tensor:
    """Compute integral images (B, H + 1, W + 1) int32 of images (B, H, W) uint8.

    Entry [:, y, x] is the sum over rows < y and columns < x. On very large images the sums overflow, but box sums below
    2**31 are still exact.
    """
    batch, height, width = gray.shape
    integral = gray.new_zeros((batch, height + 1, width + 1), dtype=torch.int32)
    if gray.device.type == "cpu":
        for image, sums in zip(gray.numpy(), integral.numpy(), strict=True):
            cv2.integral(image, sums, sdepth=cv2.CV_32S)
    else:
        torch.cumsum(torch.cumsum(gray, 2, dtype=torch.int32), 1, dtype=torch.int32, out=integral[:, 1:, 1:])
    return integral


def compute_filter_size(octave: Number, layer: Number) -> Number:
    """Side of a layer's filter in pixels."""
    return (9 + 6 * layer) << octave


def compute_margin(layer: Number) -> Number:
    """Number of samples of an octave before the first one whose filter lies inside the image."""
    return 4 + 3 * layer


def view_head(memory: Tensor, *shape: int) -> Tensor:
    """View the first elements of a flat tensor in another shape."""
    return memory.narrow(0, 0, math.prod(shape)).view(shape)


def compute_determinants(integral: Tensor, octave: int, layer: int, first: int, scratch: Tensor, out: Tensor) -> None:
    """Write a layer's determinants at the (n, m) samples from (first, first) on into `out`.

    Box sums are differences of shifted planes, which many boxes share. They are computed in memory that is reused,
    because page faults of new memory would take as long as the sums.

    Args:
        integral: (B, H + 1, W + 1) int32.
        scratch: (4, at least B * H * W) float32, overwritten.
        out: (B, n, m) float32.
    """
    size, step, start = compute_filter_size(octave, layer), 1 << octave, (first - compute_margin(layer)) << octave
    lobe, near, far, first_lobe, second_lobe = find_lobe_edges(size)
    (batch, n, m), t = out.shape, lobe // step
    whole = scratch.view(torch.int32)
    dxx, dyy = view_head(scratch[2], batch, n, m), view_head(scratch[3], batch, n, m)
    plane, line, _ = integral.stride()
    at = integral.storage_offset() + start * (line + 1)

    def change(y0: int, x0: int, y1: int, x1: int, rows: int, cols: int, step: int = step) -> Tensor:
        shape, stride = (batch, rows, cols), (plane, step * line, step)
        low, high = (integral.as_strided(shape, stride, at + y * line + x) for y, x in ((y0, x0), (y1, x1)))
        return torch.sub(high, low, out=view_head(whole[0], *shape))

    band = change(near, 0, far, 0, n, m + 3 * t)
    _sum_lobes([band.narrow(2, k * t, m) for k in range(4)], whole[1], dxx)
    band = change(0, near, 0, far, n + 3 * t, m)
    _sum_lobes([band.narrow(1, k * t, n) for k in range(4)], whole[1], dyy)

    apart = second_lobe - first_lobe
    grid = math.gcd(step, apart)  # the lobes of dxy are not always whole samples apart
    u, c, t = step // grid, apart // grid, lobe // grid
    rows, cols = (n - 1) * u + 1, (m - 1) * u + 1
    wide = cols + c
    band = change(first_lobe, first_lobe, first_lobe + lobe, first_lobe, rows + c, wide + t, grid)
    band = torch.sub(band[:, :rows:u], band[:, c::u], out=view_head(whole[1], batch, n, wide + t))
    band = torch.sub(band[..., t:], band[..., :-t], out=view_head(whole[0], batch, n, wide))
    band = torch.sub(band[..., :cols:u], band[..., c::u], out=view_head(whole[1], batch, n, m))
    dxy = view_head(scratch[0], batch, n, m).copy_(band)

    of_dxy, of_all = scale_determinant(size)
    dxx.mul_(dyy).addcmul_(dxy, dxy, value=-of_dxy)
    torch.mul(dxx, of_all, out=out)


def scale_determinant(size: int) -> tuple[float, float]:
    """Weight of dxy's square beside the product of dxx and dyy, and then of all, for sums of a filter of this size."""
    lobe, near, far, *_ = find_lobe_edges(size)
    area = lobe * (far - near)
    return (0.9 * area / lobe**2) ** 2, area**-2


def compute_determinants_at(
    integral: Tensor, octave: Tensor, layer: Tensor, image: Tensor, row: Tensor, col: Tensor
) -> Tensor:
    """Compute determinants (3, 3, K), by row and column, at and around each of K samples.

    Args:
        integral: (B, H + 1, W + 1) int32.
        octave: (K,) int64, as are the others: layer, image, and row and column in the octave's samples.
    """
    plane, line, _ = integral.stride()
    corners, areas = _make_boxes(integral.device)
    layer_id = octave * LAYERS + layer
    near = torch.arange(-1, 2, device=row.device)[:, None] - compute_margin(layer)
    y, x = (row + near) << octave, (col + near) << octave
    base = ((y * line + image * plane)[:, None] + x).int()
    offset = (corners[0] * line + corners[1]).index_select(1, layer_id)
    index = base[:, :, None] + offset  # (3, 3, 32, K)
    sums = integral.view(-1).index_select(0, index.view(-1)).view(3, 3, 4, 8, -1)
    box = (sums[:, :, 3] - sums[:, :, 2]).sub_(sums[:, :, 1]).add_(sums[:, :, 0])
    area = areas[:, layer_id]
    dxx, dyy = (box[:, :, i].sub(box[:, :, i + 1], alpha=3) / area[0] for i in (0, 2))
    dxy = (box[:, :, 4] - box[:, :, 5] - box[:, :, 6] + box[:, :, 7]) / area[1]
    return dxx * dyy - dxy * dxy


def find_lobe_edges(size: int) -> tuple[int, int, int, int, int]:
    """Positions of the lobes in a filter of this size, scaled from the paper's 9 x 9 filters.

    Returns:
        width of a lobe; first and last edge of a lobe's long side; first edges of the two diagonal lobes.
    """
    near, far, first, second = (round(size * ninths / 9) for ninths in (2, 7, 1, 5))
    return size // 3, near, far, first, second


def _sum_lobes(edges: list[Tensor], scratch: Tensor, out: Tensor) -> None:
    """Write the sum over three adjoining lobes, with weights 1, -2, 1, from the integrals at their four edges."""
    a, b, c, d = edges
    middle = torch.sub(c, b, out=view_head(scratch, *out.shape))
    out.copy_(torch.add(d, middle, alpha=-3, out=middle).sub_(a))


@lru_cache(maxsize=4)
def _make_boxes(device: torch.device) -> tuple[Tensor, Tensor]:
    """The filters of all layers (octave * LAYERS + layer) as eight boxes each: two of dxx, two of dyy, four of dxy.

    Returns:
        (2, 32, 20) int32: y and x of the boxes' corners, corner by corner; (2, 20) float32: the areas that
        normalise dxx and dyy, and dxy.
    """
    boxes, areas = [], []
    for octave, layer in product(range(OCTAVES), range(LAYERS)):
        size = compute_filter_size(octave, layer)
        lobe, near, far, first, second = find_lobe_edges(size)
        long, whole, middle = (near, far), (0, size), (lobe, 2 * lobe)
        diagonal = [(k, k + lobe) for k in (first, second)]
        spans = [(long, whole), (long, middle), (whole, long), (middle, long), *product(diagonal, diagonal)]
        boxes.append([[*product(ys, xs)] for ys, xs in spans])
        areas.append((lobe * (far - near), lobe**2 / 0.9))
    corners = torch.tensor(boxes, dtype=torch.int32).permute(3, 2, 1, 0).flatten(1, 2)
    return corners.contiguous().to(device), torch.tensor(areas, device=device).T
