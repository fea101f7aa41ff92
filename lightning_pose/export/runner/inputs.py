"""Reads what a localizer is given, as `localization/inputs.py` does, without Pillow."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np

from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.localization.inputs import Color, LoadedImage, is_video
from lightning_pose.scenes.images import decode_image, read_bytes, to_gray

__all__ = ["ImageInput", "list_images", "load_image"]


@runtime_checkable
class PillowImage(Protocol):
    """What is used of a PIL image, so that Pillow need not be there."""

    def convert(self, mode: str) -> PillowImage: ...
    def getexif(self) -> Any: ...


ImageInput = str | Path | np.ndarray | PillowImage
"""One image: a file, a uint8 array (H, W) gray or (H, W, 3) RGB, or a PIL image."""

ACCEPTED = "give an image file, a uint8 array (H, W) or (H, W, 3) RGB, a PIL image, or a list of these"

ORIENTATION, EXIF_IFD, FOCAL_35MM = 0x0112, 0x8769, 0xA405
"""Tags of EXIF: orientation, where the camera's own tags are, and the focal length on film of 36 x 24 mm."""

EXIF_MARKS = (b"Exif\0\0", b"eXIf")
"""What stands before an EXIF block in a JPEG, and in a PNG."""


def list_images(images: object) -> Sequence[object] | None:
    """The images of a list, tuple or other iterable; None for what is one image.

    Raises:
        ConfigError: it is neither.
    """
    if isinstance(images, str | Path) or is_pixels(images) or isinstance(images, PillowImage):
        return None
    if isinstance(images, bytes | dict) or not isinstance(images, Iterable):
        raise ConfigError(f"images is {str(images)[:40]!r} ({type(images).__name__}); {ACCEPTED}")
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
            raise ImageError(
                f"{image} is a folder; give its images, such as sorted(Path({str(image)!r}).glob('*.png'))"
            )
        if is_video(path) and path.is_file():
            raise ImageError(f"{image} is a video among images; give it alone")
        data = read_bytes(path)
        return LoadedImage(decode_image(data, path, color == "rgb"), str(image), *parse_exif(data))
    facts: tuple[int, float | None] = 1, None
    if isinstance(image, PillowImage):
        facts = parse_exif(EXIF_MARKS[0] + image.getexif().tobytes().removeprefix(EXIF_MARKS[0]))
        image = np.asarray(image.convert("RGB"))
    if not isinstance(image, np.ndarray) or not is_pixels(image) or image.dtype != np.uint8 or not image.size:
        what = f"of shape {image.shape} and type {image.dtype}" if isinstance(image, np.ndarray) else f"{image!r:.40}"
        raise ConfigError(f"image {number} is {what}; {ACCEPTED}")
    if color == "gray":
        return LoadedImage(to_gray(image), None, *facts)
    return LoadedImage(image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), None, *facts)


def is_pixels(value: object) -> bool:
    """Whether it is an array of the shape of an image."""
    return isinstance(value, np.ndarray) and (value.ndim == 2 or (value.ndim == 3 and value.shape[2] == 3))


def parse_exif(data: bytes) -> tuple[int, float | None]:
    """Orientation, 1 to 8, and focal length on film of 36 x 24 mm, in an image file; 1 and None if it has none."""
    starts = [at + len(mark) for mark in EXIF_MARKS if (at := data.find(mark, 0, 1 << 18)) >= 0]
    exif = data[starts[0] : starts[0] + (1 << 16)] if starts else b""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(exif[:4])
    if order is None:
        return 1, None
    try:
        tags = dict(list_tags(exif, order, struct.unpack_from(f"{order}I", exif, 4)[0]))
        inner = dict(list_tags(exif, order, tags[EXIF_IFD])) if EXIF_IFD in tags else {}
    except struct.error:  # a damaged block says nothing
        return 1, None
    orientation, focal = tags.get(ORIENTATION, 1), inner.get(FOCAL_35MM, 0)
    return orientation if orientation in range(1, 9) else 1, float(focal) if 1 <= focal <= 2000 else None


def list_tags(exif: bytes, order: str, start: int) -> Iterator[tuple[int, int]]:
    """Tags and values, of 16 or 32 bits, of one directory of a TIFF header."""
    (entries,) = struct.unpack_from(f"{order}H", exif, start)
    for i in range(entries):
        at = start + 2 + 12 * i
        tag, kind = struct.unpack_from(f"{order}HH", exif, at)
        yield tag, struct.unpack_from(f"{order}{'H' if kind == 3 else 'I'}", exif, at + 8)[0]
