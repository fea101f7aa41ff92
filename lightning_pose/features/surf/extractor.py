"""SURF, upright or oriented: keypoints with descriptors of 64 numbers, which the thesis's networks read.

Bay, Tuytelaars, Van Gool: "SURF: Speeded Up Robust Features", ECCV 2006, and the extended version of 2008,
with OpenCV's conventions (window placement, angles, the order of the numbers), as batched tensor
operations that run alike on CPU and GPU.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightning_pose.concurrency.threads import use_one_thread
from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.features.base import LocalExtractor, Record
from lightning_pose.features.surf.descriptor import UPRIGHT_ANGLE, compute_descriptors, compute_orientations
from lightning_pose.features.surf.detector import detect_keypoints
from lightning_pose.features.surf.hessian import compute_integral_image

__all__ = ["SURF", "SurfFeatures"]

BATCH = 16
"""Images in a batch on a GPU. On a CPU a batch is one image, because one image fills the CPU's cache."""


class SurfFeatures(NamedTuple):
    """The N strongest features of each image, strongest first, zero rows at the end.

    Attributes:
        keypoints: (B, N, 5) float32: x, y, size (pixels), response, angle (degrees, clockwise from x).
        descriptors: (B, N, 64) float32, L2-normalised.
        count: (B,) int64, how many of the N rows are real.
    """

    keypoints: Tensor
    descriptors: Tensor
    count: Tensor


class SURF(LocalExtractor):
    """SURF keypoints and descriptors, 4 octaves of 3 layers.

    Args:
        n_features: N, how many of the strongest features to return.
        upright: do not compute each keypoint's orientation (U-SURF): this is faster, and the thesis does the same.
        threshold: the determinant of the Hessian of a keypoint must exceed it; the scale is that of OpenCV's
            hessianThreshold, and 0 keeps every keypoint.
        with_geometry: as for `LocalExtractor`.

    Raises:
        ConfigError: n_features is not positive, or threshold is negative.
    """

    descriptor_dim: ClassVar[int] = 64
    holds_interpreter: ClassVar[bool] = True

    def __init__(
        self, n_features: int = 300, upright: bool = True, threshold: float = 0.0, with_geometry: bool = False
    ) -> None:
        super().__init__(n_features, with_geometry)
        if not threshold >= 0:
            raise ConfigError(f"threshold is {threshold}; give 0 to keep every feature, or a positive number")
        self.upright = upright
        self.threshold = threshold

    @property
    def settings(self) -> Mapping[str, str | int | float | bool | None]:
        return {"upright": self.upright, "threshold": self.threshold, "n_stored": self.n_stored}

    @torch.no_grad()
    def __call__(self, images: Tensor) -> SurfFeatures:
        """Compute features of (B, H, W) grayscale images, uint8 or float in 0..1, on the images' device.

        Float images are rounded to 8 bits first. Images smaller than the filters have no features.

        Raises:
            ImageError: another number of axes, no pixels, another type, or floats outside 0..1.
        """
        return self._compute_features(_convert_to_uint8(images), self.n_features)

    @torch.no_grad()
    def extract(self, images: Sequence[np.ndarray]) -> list[Record]:
        """One record of `n_stored` rows for each (H, W) uint8 image; images of equal size share a batch.

        Raises:
            ImageError: an image is not an (H, W) uint8 array, or has no pixels.
        """
        alike: dict[tuple[int, ...], list[int]] = defaultdict(list)
        for i, image in enumerate(images):
            if image.ndim != 2 or image.size == 0 or image.dtype != np.uint8:
                raise ImageError(
                    f"image {i} has shape {image.shape} and type {image.dtype}; give (H, W) uint8 grayscale"
                )
            alike[image.shape].append(i)
        records: list[Record] = [{}] * len(images)
        for (height, width), members in alike.items():
            batch = torch.from_numpy(np.stack([images[i] for i in members]))
            found = self._compute_features(batch, self.n_stored)
            for i, keypoints, descriptors, count in zip(members, *(f.numpy() for f in found), strict=True):
                records[i] = {
                    "descriptors": descriptors,
                    "keypoints": keypoints,
                    "count": np.asarray(count, dtype=np.int64),
                    "image_size": np.array([width, height], dtype=np.int64),
                }
        return records

    def check_mirror(self) -> None:
        """Raise a ConfigError for oriented descriptors: the mirrored ones cannot be computed without the image."""
        if not self.upright:
            raise ConfigError("data.mirror is on, but SURF descriptors are oriented; set upright: true, or turn it off")

    def mirror(self, features: Tensor) -> Tensor:
        """Mirror features (..., N, D): reverse the columns of 4 x 4 cells, and the signs of the sums across and of x.

        In OpenCV's order the cells of a descriptor go to the right first, and a cell has four sums: upwards, across,
        and the absolute values of both.
        """
        cells = features[..., :64].unflatten(-1, (4, 4, 4)).flip(-3) * features.new_tensor([1.0, -1, 1, 1])
        rest = features[..., 64:].clone()
        rest[..., :1] = -rest[..., :1]
        return torch.cat([cells.flatten(-3), rest], dim=-1)

    def _compute_features(self, gray: Tensor, n: int) -> SurfFeatures:
        """Compute the n strongest features of images (B, H, W) uint8, batch by batch."""
        with use_one_thread():
            batches = [self._compute_batch(batch, n) for batch in gray.split(1 if gray.device.type == "cpu" else BATCH)]
        return SurfFeatures(*(torch.cat(column) for column in zip(*batches, strict=True)))

    def _compute_batch(self, gray: Tensor, n: int) -> SurfFeatures:
        """Compute the n strongest features of the images of one batch."""
        integral = compute_integral_image(gray)
        found = detect_keypoints(integral, n, self.threshold)
        image = torch.arange(len(gray), device=gray.device).repeat_interleave(n)
        xy, size = found.xy.flatten(0, 1), found.size.flatten()
        angle = None if self.upright else compute_orientations(integral, image, xy, size)
        descriptors = compute_descriptors(integral, image, xy, size, angle).unflatten(0, (len(gray), n))
        degrees = torch.full_like(size, UPRIGHT_ANGLE) if angle is None else angle
        degrees = degrees.view_as(found.size) * (found.size > 0)
        columns = torch.stack([found.size, found.response, degrees], -1)
        return SurfFeatures(torch.cat([found.xy, columns], -1), descriptors, found.count)


def _convert_to_uint8(images: Tensor) -> Tensor:
    """Check images (B, H, W) and round floats in 0..1 to uint8; raise the errors of `SURF.__call__`."""
    if images.ndim != 3 or 0 in images.shape[1:]:
        raise ImageError(
            f"the images have shape {tuple(images.shape)}; give (B, H, W) grayscale (one image: image[None])"
        )
    if images.dtype == torch.uint8:
        return images
    if not images.is_floating_point():
        raise ImageError(f"the images have type {images.dtype}; give uint8, or floats in 0..1")
    if images.numel() and not (images.min() >= 0 and images.max() <= 1):
        low, high = images.min().item(), images.max().item()
        raise ImageError(f"the float images range from {low:g} to {high:g}; scale them to 0..1")
    return (images * 255).round().to(torch.uint8)
