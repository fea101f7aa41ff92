"""What a localizer is given: image files, arrays and PIL images, and in one line what is none of these."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from PIL import Image

from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.scenes.images import decode_image, read_bytes, to_gray

__all__ = ["ImageInput", "LoadedImage", "is_video", "list_images", "load_image"]

ImageInput = str | Path | bytes | np.ndarray | Image.Image
"""One image: a file, the bytes of one, a uint8 array (H, W) gray or (H, W, 3) RGB, or a PIL image."""

Color = Literal["gray", "rgb"]

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv", ".3gp")

REMEDY = "give an image file or its bytes, a uint8 array, a PIL image, or a list of these"

ORIENTATION_TAG, EXIF_FOLDER, FOCAL_35MM_TAG = 0x0112, 0x8769, 0xA405
"""Tags of EXIF: the orientation, where the camera's own tags are, and the focal length on film of 36 x 24 mm."""


@dataclass(frozen=True)
class LoadedImage:
    """An image as an extractor reads it.

    Attributes:
        array: (H, W) or (H, W, 3) uint8, pixels as stored.
        name: its path as given; None for an image in memory.
        orientation: of EXIF, 1 to 8; 1 if it has none.
        focal_35mm: focal length in millimetres on film of 36 x 24 mm, as EXIF has it; None if it does not.
    """

    array: np.ndarray
    name: str | None = None
    orientation: int = 1
    focal_35mm: float | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.array.shape[1], self.array.shape[0]

    def turn(self, quarters: int) -> LoadedImage:
        """The image turned clockwise by so many quarters, without its EXIF orientation."""
        return replace(self, array=np.ascontiguousarray(np.rot90(self.array, -quarters)), orientation=1)


def is_video(path: str | Path) -> bool:
    """Whether a path has a video file's ending."""
    return Path(path).suffix.lower() in VIDEO_SUFFIXES


def list_images(images: object) -> Sequence[object] | None:
    """The images of a list, tuple or other iterable; None for what is one image.

    Raises:
        ConfigError: it is neither.
    """
    if isinstance(images, str | Path | bytes | Image.Image) or _is_image_array(images):
        return None
    if isinstance(images, dict) or not isinstance(images, Iterable):
        raise ConfigError(f"images is {_describe(images)}; {REMEDY}")
    return list(images)


def load_image(image: object, color: Color, number: int = 0) -> LoadedImage:
    """Read or convert one image.

    Args:
        image: what should be an `ImageInput`.
        color: what the extractor reads.
        number: of the image in its list, for messages.

    Raises:
        ConfigError: it is something else, or an array of another shape or type.
        ImageError: a file is missing, is a folder or a video, or cannot be read.
    """
    if isinstance(image, str | Path):
        return _read_file(image, color)
    if isinstance(image, bytes):
        return _decode(image, "the image" if number == 0 else f"image {number}", color, None)
    if isinstance(image, Image.Image):
        orientation, focal = _read_exif(image)
        return LoadedImage(_convert_color(np.asarray(image.convert("RGB")), color), None, orientation, focal)
    if not isinstance(image, np.ndarray):
        raise ConfigError(f"image {number} is {_describe(image)}; {REMEDY}")
    if not _is_image_array(image) or image.dtype != np.uint8 or not image.size:
        raise ConfigError(
            f"image {number} is an array of shape {image.shape} and type {image.dtype}; give uint8 of shape (H, W) "
            "gray or (H, W, 3) RGB"
        )
    return LoadedImage(_convert_color(image, color))


def _is_image_array(value: object) -> bool:
    return isinstance(value, np.ndarray) and (value.ndim == 2 or (value.ndim == 3 and value.shape[2] == 3))


def _convert_color(array: np.ndarray, color: Color) -> np.ndarray:
    """Pixels (H, W) or (H, W, 3) as the extractor reads them."""
    if color == "gray":
        return to_gray(array)
    return array if array.ndim == 3 else cv2.cvtColor(array, cv2.COLOR_GRAY2RGB)


def _read_file(image: str | Path, color: Color) -> LoadedImage:
    """An image file with what its EXIF block says."""
    path = Path(image).expanduser()
    if path.is_dir():
        raise ImageError(f"{image} is a folder; give its images, such as sorted(Path({str(image)!r}).glob('*.png'))")
    if is_video(path) and path.is_file():
        raise ImageError(f"{image} is a video among images; give it alone")
    return _decode(read_bytes(path), path, color, str(image))


def _decode(data: bytes, where: str | Path, color: Color, name: str | None) -> LoadedImage:
    """An encoded image with what its EXIF block says.

    Args:
        data: the whole file.
        where: it is from, for messages.
        color: what the extractor reads.
        name: of the image.
    """
    array = decode_image(data, where, color == "rgb")
    try:
        with Image.open(io.BytesIO(data)) as opened:
            orientation, focal = _read_exif(opened)
    except (OSError, ValueError, Image.DecompressionBombError):  # OpenCV reads more formats
        orientation, focal = 1, None
    return LoadedImage(array, name, orientation, focal)


def _read_exif(image: Image.Image) -> tuple[int, float | None]:
    """The orientation, 1 to 8, and the focal length on film of 36 x 24 mm, in millimetres."""
    try:
        exif = image.getexif()
        orientation, focal = exif.get(ORIENTATION_TAG, 1), exif.get_ifd(EXIF_FOLDER).get(FOCAL_35MM_TAG)
        focal = None if focal is None else float(focal)
    except (ValueError, TypeError, KeyError, SyntaxError, OSError, ZeroDivisionError):  # a damaged block says nothing
        return 1, None
    return (
        orientation if orientation in range(1, 9) else 1,
        focal if focal is not None and 1 <= focal <= 2000 else None,
    )


def _describe(value: object) -> str:
    """A value's type and beginning, for a message."""
    text = repr(value)
    return f"{text if len(text) <= 40 else text[:40] + '...'} ({type(value).__name__})"
