"""What a localizer is given: image files and arrays, and in one line what is neither."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.features.base import FeatureExtractor
from lightning_pose.geometry.camera import Camera
from lightning_pose.scenes.cameras import scale_camera

__all__ = ["enlarge_images", "read_images"]

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv", ".3gp")

MIN_ENLARGEMENT, MAX_ENLARGEMENT = 1.2, 4.0
"""By how much images are enlarged at least, and at most."""

REMEDY = "give an image file, a uint8 array, or a list of these"


def read_images(images: object, extractor: FeatureExtractor) -> list[np.ndarray]:
    """The images as arrays that the extractor reads; one that stands alone is a list of one.

    Raises:
        ConfigError: it is something else, or an array of another shape or type than the extractor reads.
        ImageError: a file is missing, is a folder or a video, or cannot be read.
    """
    axes = 2 if extractor.color == "gray" else 3
    if isinstance(images, str | Path) or (isinstance(images, np.ndarray) and images.ndim == axes):
        images = [images]
    if isinstance(images, bytes | dict) or not isinstance(images, Iterable):
        raise ConfigError(f"images is {_describe(images)}; {REMEDY}")
    return [_read_image(image, i, extractor, axes) for i, image in enumerate(images)]


def _read_image(image: object, number: int, extractor: FeatureExtractor, axes: int) -> np.ndarray:
    """One image as an array."""
    if isinstance(image, str | Path):
        path = Path(image).expanduser()
        if path.is_dir():
            raise ImageError(
                f"{image} is a folder; give its images, such as sorted(Path({str(image)!r}).glob('*.png'))"
            )
        if path.suffix.lower() in VIDEO_SUFFIXES and path.is_file():
            raise ImageError(f"{image} is a video; give its frames as a list of arrays")
        return extractor.read(path)
    if not isinstance(image, np.ndarray):
        raise ConfigError(f"image {number} is {_describe(image)}; {REMEDY}")
    if image.ndim != axes or image.dtype != np.uint8 or not image.size or (axes == 3 and image.shape[2] != 3):
        wanted = "(H, W) gray" if axes == 2 else "(H, W, 3) RGB"
        raise ConfigError(
            f"image {number} is an array of shape {image.shape} and type {image.dtype}; {extractor.name} reads uint8 "
            f"{wanted} images"
        )
    return image


def _describe(value: object) -> str:
    """A value's type and beginning, for a message."""
    text = repr(value)
    return f"{text if len(text) <= 40 else text[:40] + '...'} ({type(value).__name__})"


def enlarge_images(arrays: list[np.ndarray], view: Camera, camera: Camera | None) -> list[np.ndarray]:
    """Images in which a pixel is as small an angle as in a map's images; the same list where none is too small.

    Keypoints of small images are too few and too uncertain for a map of larger ones: in images of half the size they
    locate three times worse, and in the same images enlarged as well as in the large ones.

    Args:
        arrays: (H, W) or (H, W, 3).
        view: the camera of the map's images.
        camera: of these images, scaled to each; `view` if None.

    Raises:
        ConfigError: an image has another shape than those that the camera is for.
    """
    known = view if camera is None else camera
    factors = [
        view.focal_px / scale_camera(known, array.shape[1], array.shape[0], setting="camera").focal_px
        for array in arrays
    ]
    if max(factors) < MIN_ENLARGEMENT:
        return arrays
    enlarged = []
    for array, factor in zip(arrays, factors, strict=True):
        if factor >= MIN_ENLARGEMENT:
            factor = min(factor, MAX_ENLARGEMENT)
            size = round(array.shape[1] * factor), round(array.shape[0] * factor)
            array = cv2.resize(array, size, interpolation=cv2.INTER_CUBIC)
        enlarged.append(array)
    return enlarged
