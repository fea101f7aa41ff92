"""Checks the head of an image in memory before anything is decoded: its kind and how many pixels it has."""

from __future__ import annotations

import io

from PIL import Image

from lightning_pose.serving.errors import RequestError

__all__ = ["KINDS", "check_picture"]

KINDS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "PPM")
"""Kinds of images, by Pillow's names, that OpenCV decodes too."""


def check_picture(data: bytes, max_pixels: int) -> tuple[int, int]:
    """Width and height of an image, from its head.

    A file of kilobytes may say that it has 10^9 pixels, and decoding it would fill the memory.

    Raises:
        RequestError: the bytes are no image of these kinds, or it has too many pixels.
    """
    try:
        with Image.open(io.BytesIO(data), formats=KINDS) as image:
            width, height = image.size
    except Image.DecompressionBombError:
        raise _too_many_pixels(max_pixels) from None
    except Exception as error:  # Pillow's readers of damaged heads end in many kinds of exception
        kinds = ", ".join(KINDS)
        raise RequestError(415, "not_an_image", f"the bytes are no image of a kind that is read: {kinds}") from error
    if width * height > max_pixels:
        raise _too_many_pixels(max_pixels, f" ({width}x{height})")
    return width, height


def _too_many_pixels(max_pixels: int, size: str = "") -> RequestError:
    message = f"the image has more than {max_pixels:,} pixels{size}; send a smaller one"
    return RequestError(413, "too_many_pixels", message)
