"""Reads what a localizer is given, as `localization/inputs.py` does, without Pillow."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.localization.inputs import REMEDY, Color, LoadedImage, is_image_array, is_video
from lightning_pose.scenes.images import convert_pixels, decode_pixels, read_bytes, to_gray

__all__ = ["list_images", "load_image"]

EXIF_IFD, FOCAL_35MM = 0x8769, 0xA405
"""Tags of EXIF: where the camera's own tags are, and the focal length on film of 36 x 24 mm."""


def list_images(images: object) -> Sequence[object] | None:
    """The images of a list, tuple or other iterable; None for what is one image.

    Raises:
        ConfigError: it is neither.
    """
    if isinstance(images, str | Path) or is_image_array(images) or hasattr(images, "convert"):
        return None
    if isinstance(images, bytes | dict) or not isinstance(images, Iterable):
        raise ConfigError(f"images is {str(images)[:40]!r} ({type(images).__name__}); {REMEDY}")
    return list(images)


def load_image(image: object, color: Color, number: int = 0) -> LoadedImage:
    """Read or convert one image: a file, a uint8 array, or a PIL image.

    Raises:
        ConfigError: it is something else, or an array of another shape or type.
        ImageError: a file is missing, is a folder or a video, or cannot be read.
    """
    if isinstance(image, str | Path):
        path = Path(image).expanduser()
        if path.is_dir():
            raise ImageError(f"{image} is a folder; give its images, such as {image}/*.png")
        if is_video(path) and path.is_file():
            raise ImageError(f"{image} is a video among images; give it alone")
        pixels, exif = decode_pixels(read_bytes(path), path)
        orientation, focal_35mm = parse_exif(exif)
        return LoadedImage(convert_pixels(pixels, color == "rgb"), str(image), orientation, focal_35mm)
    if hasattr(image, "convert"):
        exif = image.getexif().tobytes() if hasattr(image, "getexif") else b""
        return LoadedImage(convert_pixels(np.asarray(image.convert("RGB")), color == "rgb"), None, *parse_exif(exif))
    if not isinstance(image, np.ndarray) or not is_image_array(image) or image.dtype != np.uint8 or not image.size:
        raise ConfigError(f"image {number} is no uint8 array (H, W) or (H, W, 3); {REMEDY}")
    if color == "gray":
        return LoadedImage(to_gray(image))
    return LoadedImage(image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2RGB))


def parse_exif(exif: bytes) -> tuple[int, float | None]:
    """Orientation, 1 to 8, and focal length on film of 36 x 24 mm, of an EXIF block; 1 and None if it has none."""
    exif = exif.removeprefix(b"Exif\0\0")
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(exif[:4])
    try:
        tags = {} if order is None else dict(list_tags(exif, order, struct.unpack_from(f"{order}I", exif, 4)[0]))
        inner = dict(list_tags(exif, order or "<", tags[EXIF_IFD])) if EXIF_IFD in tags else {}
    except struct.error:  # a damaged block says nothing
        return 1, None
    orientation, focal = tags.get(0x0112, 1), inner.get(FOCAL_35MM)
    return orientation if orientation in range(1, 9) else 1, float(focal) if focal and 1 <= focal <= 2000 else None


def list_tags(exif: bytes, order: str, start: int) -> Iterator[tuple[int, int]]:
    """Tags and values, of 16 or 32 bits, of one directory of a TIFF header."""
    (entries,) = struct.unpack_from(f"{order}H", exif, start)
    for i in range(entries):
        at = start + 2 + 12 * i
        tag, kind = struct.unpack_from(f"{order}HH", exif, at)
        yield tag, struct.unpack_from(f"{order}{'H' if kind == 3 else 'I'}", exif, at + 8)[0]
