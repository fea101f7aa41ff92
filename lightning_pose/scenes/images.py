"""Reads image files into 8-bit arrays, with errors that name the file and the remedy."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np

from lightning_pose.errors import ImageError

__all__ = ["decode_image", "read_bytes", "read_gray", "read_rgb", "to_gray"]

if "OPENCV_LOG_LEVEL" not in os.environ:
    cv2.utils.logging.setLogLevel(
        1
    )  # fatal only: OpenCV prints warnings about bad files that ImageError reports as well

# Poses and intrinsics of a dataset refer to the pixels as stored, so EXIF orientation is ignored.
_FLAGS = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION


def read_gray(path: Path | str) -> np.ndarray:
    """Read an image file as (H, W) uint8; colour is weighted by ITU-R BT.601, alpha is dropped.

    16-bit images are scaled to 8 bits by their full range; EXIF orientation is ignored.

    Raises:
        ImageError: the file is missing, empty, truncated, or not an image that OpenCV decodes.
    """
    return decode_image(read_bytes(path), path, color=False)


def read_rgb(path: Path | str) -> np.ndarray:
    """Read an image file as (H, W, 3) uint8 RGB; gray and palette images are expanded; else as `read_gray`.

    Raises:
        ImageError: as `read_gray`.
    """
    return decode_image(read_bytes(path), path, color=True)


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
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), _FLAGS)
    except cv2.error:
        image = None
    if image is None:
        raise ImageError(
            f"{path} is truncated or is not an image that OpenCV reads ({len(data)} bytes); "
            "copy it again, or convert it to PNG or JPEG"
        )
    if image.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"{path} holds {image.dtype} pixels; convert it to 8 or 16 bits a channel")
    image = _to_uint8(image)
    # Decoders of different formats weight colours differently when asked for gray. Converted here, a file and the same
    # pixels in memory give the same gray.
    return image if color else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def to_gray(image: np.ndarray) -> np.ndarray:
    """Convert an image array of a user into (H, W) uint8 gray.

    Args:
        image: (H, W), (H, W, 1), (H, W, 3) RGB or (H, W, 4) RGBA (alpha is dropped); uint8, uint16 over its
            full range, or floating point in 0..1.

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


def _to_uint8(image: np.ndarray) -> np.ndarray:
    """Convert uint16 by its upper 8 bits, and floats in 0..1 by rounding; uint8 is returned as it is."""
    if image.dtype == np.uint16:
        return (image >> 8).astype(np.uint8)
    if image.dtype == np.uint8:
        return image
    return np.rint(image * 255).astype(np.uint8)
