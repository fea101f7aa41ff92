"""Reads image files into 8-bit arrays, with errors that name the file and the remedy."""

from __future__ import annotations

import logging
import os
import struct
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from PIL import Image

from lightning_pose.errors import ImageError

__all__ = [
    "DECODING_VERSION",
    "ImageFacts",
    "decode_image",
    "find_bits",
    "measure_image",
    "read_bytes",
    "read_gray",
    "read_image_size",
    "read_rgb",
    "to_gray",
]

log = logging.getLogger("lightning_pose")

if "OPENCV_LOG_LEVEL" not in os.environ:
    cv2.utils.logging.setLogLevel(
        1
    )  # fatal only: OpenCV prints warnings about bad files that ImageError reports as well

# Poses and intrinsics of every format that is read here refer to the pixels as stored: COLMAP and other structure from
# motion ignore the EXIF orientation, and other datasets have none. So it is ignored everywhere, and said.
_FLAGS = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION

DEPTHS = (8, 10, 12, 14, 16)
"""Bits a channel of cameras. Each uses a part of the range of a 16-bit file."""

DECODING_VERSION = 2
"""Raised when the same file gives other pixels, so that no features of the old ones are read from a cache.

Version 1 read images of 9 to 15 bits in 16-bit files as dark ones.
"""

EXIF = cv2.IMAGE_METADATA_EXIF
ORIENTATION_TAG = 0x0112
_warned_orientations: set[int] = set()


class ImageFacts(NamedTuple):
    """What `check` shows of an image file.

    Attributes:
        width: pixels as stored.
        height: likewise.
        bits: see `find_bits`.
        orientation: of EXIF, 1 to 8; 1 if there is none.
        blank: whether all pixels have one value.
    """

    width: int
    height: int
    bits: int
    orientation: int
    blank: bool


def read_gray(path: Path | str) -> np.ndarray:
    """Read an image file as (H, W) uint8; colour is weighted by ITU-R BT.601, alpha is dropped.

    16-bit images are scaled to 8 bits by the bits that they use, see `find_bits`. EXIF orientation is ignored, with a
    warning: the first of each orientation in a process.

    Raises:
        ImageError: the file is missing, empty, truncated, or not an image that OpenCV decodes.
    """
    return _read_image(path, color=False)


def read_rgb(path: Path | str) -> np.ndarray:
    """Read an image file as (H, W, 3) uint8 RGB; gray and palette images are expanded; else as `read_gray`.

    Raises:
        ImageError: as `read_gray`.
    """
    return _read_image(path, color=True)


def read_image_size(path: Path | str) -> tuple[int, int]:
    """Width and height of an image file, in pixels as stored; of usual formats only the head is read.

    Raises:
        ImageError: as `read_gray`.
    """
    try:
        with Image.open(path) as image:
            return image.size
    except (OSError, ValueError, Image.DecompressionBombError):  # OpenCV may read it all the same
        height, width = read_gray(path).shape
        return width, height


def read_bytes(path: Path | str) -> bytes:
    """Read an encoded image file.

    Raises:
        ImageError: the file is missing, a folder, empty, or may not be read.
    """
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise ImageError(f"{path} does not exist; check the path, or remove the frame from the dataset") from None
    except IsADirectoryError:
        raise ImageError(f"{path} is a folder; give the path of one image file") from None
    except OSError as error:
        raise ImageError(f"{path} cannot be read ({error.strerror}); check its permissions") from error
    if not data:
        raise ImageError(f"{path} is empty; copy or download it again")
    return data


def decode_image(data: bytes, path: Path | str, color: bool) -> np.ndarray:
    """Decode the bytes of an image file: (H, W, 3) uint8 RGB if `color`, else (H, W) uint8.

    Args:
        data: the whole encoded file, not empty.
        path: where the bytes come from, for the message.
        color: RGB or gray.

    Raises:
        ImageError: the bytes are not an image, are cut short, or hold neither 8 nor 16 bits a channel.
    """
    return _convert_pixels(_decode_pixels(data, path)[0], color)


def measure_image(data: bytes, path: Path | str) -> ImageFacts:
    """Decode the bytes of an image file, and measure what `check` shows.

    Raises:
        ImageError: as `decode_image`.
    """
    image, orientation = _decode_pixels(data, path)
    height, width = image.shape[:2]
    blank = bool((image == image[:1, :1]).all())
    return ImageFacts(width, height, find_bits(image), orientation, blank)


def find_bits(image: np.ndarray) -> int:
    """Bits a channel that an image uses: 8 of uint8; of uint16 the least of `DEPTHS` that holds its largest value.

    A 16-bit file does not say how many bits its camera has. With a guess for each image, a dark image of a 12-bit
    camera may be taken for one of 10 bits, which makes it brighter, not worse.
    """
    if image.dtype == np.uint8 or not image.size:
        return 8
    largest = int(image.max())
    return next(bits for bits in DEPTHS if largest < 1 << bits)


def to_gray(image: np.ndarray) -> np.ndarray:
    """Convert an image array of a user into (H, W) uint8 gray.

    Args:
        image: (H, W), (H, W, 1), (H, W, 3) RGB or (H, W, 4) RGBA (alpha is dropped); uint8, uint16 (see
            `find_bits`), or floating point in 0..1.

    Raises:
        ImageError: another shape, another dtype, or floats outside 0..1.
    """
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.size == 0 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] in (3, 4))):
        raise ImageError(f"an image of shape {image.shape}; give (H, W), (H, W, 3) RGB or (H, W, 4) RGBA")
    if np.issubdtype(image.dtype, np.floating):
        low, high = float(image.min()), float(image.max())
        if not (low >= 0 and high <= 1):  # written so that NaN is refused too
            raise ImageError(f"a {image.dtype} image with values {low:g}..{high:g}; scale it to 0..1, or give uint8")
    elif image.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"a {image.dtype} image; give uint8, uint16, or floats in 0..1")
    image = _to_uint8(image)
    return image if image.ndim == 2 else cv2.cvtColor(image[:, :, :3], cv2.COLOR_RGB2GRAY)


def _read_image(path: Path | str, color: bool) -> np.ndarray:
    """Read and decode an image file; warn if it has an EXIF orientation of which no other image had a warning."""
    image, orientation = _decode_pixels(read_bytes(path), path)
    if orientation != 1 and orientation not in _warned_orientations:
        _warned_orientations.add(orientation)
        log.warning(
            "%s has EXIF orientation %d, which is ignored: poses refer to pixels as stored; if the images of the scene "
            "are stored upright, turn the pixels of this one (other such images are not named)",
            path,
            orientation,
        )
    return _convert_pixels(image, color)


def _decode_pixels(data: bytes, path: Path | str) -> tuple[np.ndarray, int]:
    """Pixels (H, W, 3) RGB as stored, uint8 or uint16, and the EXIF orientation, 1 to 8."""
    try:
        image, kinds, metadata = cv2.imdecodeWithMetadata(np.frombuffer(data, np.uint8), flags=_FLAGS)
    except cv2.error:
        image, kinds, metadata = None, [], []
    if image is None or not image.size:
        raise ImageError(f"{path} {_describe_undecodable(data)}")
    if image.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"{path} holds {image.dtype} pixels; convert it to 8 or 16 bits a channel")
    exif = [np.asarray(block).tobytes() for kind, block in zip(kinds, metadata, strict=True) if kind == EXIF]
    return image, _parse_orientation(exif[0]) if exif else 1


def _describe_undecodable(data: bytes) -> str:
    """What the bytes of a file are that OpenCV does not decode, and what to do about it."""
    start = data[:200].lstrip().lower()
    if start.startswith(b"version https://git-lfs"):
        return "is a Git LFS pointer, not the image; run `git lfs pull` in the dataset's repository"
    if data[4:8] == b"ftyp" and data[8:12] in (b"heic", b"heix", b"mif1", b"msf1", b"hevc"):
        return "is a HEIC photo, whatever its name says; convert it to JPEG"
    if start.startswith((b"<!doctype", b"<html")):
        return "is a web page, not an image; download it again"
    try:
        raw = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        raw = None
    if raw is not None:
        return f"holds {raw.dtype} pixels; convert it to 8 or 16 bits a channel"
    size = f"({len(data)} bytes)"
    return f"is truncated or is not an image that OpenCV reads {size}; copy it again, or convert it to PNG or JPEG"


def _parse_orientation(exif: bytes) -> int:
    """The orientation, 1 to 8, in an EXIF block (a TIFF header and its first directory); 1 if it has none."""
    exif = exif.removeprefix(b"Exif\0\0")
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(exif[:4])
    try:
        if order is not None:
            (start,) = struct.unpack_from(f"{order}I", exif, 4)
            (entries,) = struct.unpack_from(f"{order}H", exif, start)
            for i in range(entries):
                tag, _, _, value = struct.unpack_from(f"{order}HHIH", exif, start + 2 + 12 * i)
                if tag == ORIENTATION_TAG:
                    return value if 1 <= value <= 8 else 1
    except struct.error:
        pass  # a damaged block says nothing
    return 1


def _convert_pixels(image: np.ndarray, color: bool) -> np.ndarray:
    """Pixels as stored to (H, W, 3) uint8 RGB if `color`, else (H, W) uint8."""
    image = _to_uint8(image)
    # Decoders of different formats weight colours differently when asked for gray. Converted here, a file and the same
    # pixels in memory give the same gray.
    return image if color else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def _to_uint8(image: np.ndarray) -> np.ndarray:
    """Convert uint16 by the upper 8 of the bits in use, and floats in 0..1 by rounding; uint8 is returned as it is."""
    if image.dtype == np.uint16:
        return (image >> (find_bits(image) - 8)).astype(np.uint8)
    if image.dtype == np.uint8:
        return image
    return np.rint(image * 255).astype(np.uint8)
