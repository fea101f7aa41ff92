"""Reads an uploaded image's head before anything is decoded: what kind it is, and how many pixels it has."""

from __future__ import annotations

import io

from PIL import Image

from lightning_pose.errors import ImageError

__all__ = ["KINDS", "MAX_PIXELS", "NotAnImageError", "TooManyPixelsError", "check_head"]

KINDS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "PPM")
"""Kinds of images, by Pillow's names, that OpenCV decodes too."""

MAX_PIXELS = 25_000_000
"""Of an image from elsewhere, unless the user gives another limit."""


class NotAnImageError(ImageError):
    """Bytes that are no image of one of `KINDS`."""


class TooManyPixelsError(ImageError):
    """An image that would fill the memory."""


def check_head(data: bytes, max_pixels: int = MAX_PIXELS) -> tuple[int, int]:
    """Width and height of an image, from its head.

    A file of kilobytes may say that it has 10^9 pixels, and decoding it would fill the memory.

    Args:
        data: an encoded image.
        max_pixels: width times height that is allowed.

    Raises:
        NotAnImageError: the bytes are no image of these kinds.
        TooManyPixelsError: it has more pixels.
    """
    try:
        with Image.open(io.BytesIO(data), formats=KINDS) as image:
            width, height = image.size
    except Image.DecompressionBombError:
        raise TooManyPixelsError(_describe(max_pixels)) from None
    except Exception as error:  # Pillow's readers of damaged heads end in many kinds of exception
        raise NotAnImageError(f"the bytes are no image of a kind that is read: {', '.join(KINDS)}") from error
    if width * height > max_pixels:
        raise TooManyPixelsError(_describe(max_pixels, f" ({width}x{height})"))
    return width, height


def _describe(max_pixels: int, size: str = "") -> str:
    return f"the image has more than {max_pixels:,} pixels{size}; send a smaller one"
