"""Damaged and unusual images: an array of the right shape and type, or one line that says what is wrong."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from lightning_pose.errors import ImageError
from lightning_pose.scenes.images import decode_image, measure_image
from tests.data.helpers import make_turned_jpeg


def _encode(image: Image.Image, format: str, **settings: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format, **settings)
    return buffer.getvalue()


def _make_images() -> Mapping[str, bytes]:
    pixels = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8)
    image = Image.fromarray(pixels)
    deep = cv2.imencode(".png", pixels.astype(np.uint16) * 257)[1].tobytes()
    return {
        "png": _encode(image, "PNG"),
        "jpeg": _encode(image, "JPEG"),
        "turned jpeg": make_turned_jpeg(pixels, 6),
        "cmyk jpeg": _encode(image.convert("CMYK"), "JPEG"),
        "16 bits": deep,
        "palette": _encode(image.convert("P"), "PNG"),
        "alpha": _encode(image.convert("RGBA"), "PNG"),
        "animated gif": _encode(image, "GIF", save_all=True, append_images=[image.rotate(90)]),
        "bmp": _encode(image, "BMP"),
        "tiff": _encode(image, "TIFF"),
        "webp": _encode(image, "WEBP"),
        "1x1": _encode(image.resize((1, 1)), "PNG"),
        "wide": _encode(image.resize((20000, 1)), "PNG"),
        "nothing": b"",
    }


IMAGES = _make_images()


@pytest.mark.parametrize("name", IMAGES)
@given(
    flips=st.lists(st.tuples(st.integers(0, 10**6), st.integers(1, 255)), max_size=8),
    length=st.none() | st.integers(0, 10**4),
    color=st.booleans(),
)
def test_damaged_image_is_decoded_or_refused_in_one_line(
    name: str, flips: list[tuple[int, int]], length: int | None, color: bool
) -> None:
    data = bytearray(IMAGES[name][:length])
    for at, mask in flips:
        if data:
            data[at % len(data)] ^= mask
    for step in (lambda: decode_image(bytes(data), "a.png", color), lambda: measure_image(bytes(data), "a.png")):
        try:
            found = step()
        except ImageError as error:
            found = str(error)
        if isinstance(found, str):
            assert "a.png" in found
            assert "\n" not in found
        elif isinstance(found, np.ndarray):
            assert found.dtype == np.uint8
            assert found.ndim == (3 if color else 2)
            assert found.size


def test_undamaged_images_keep_their_size() -> None:
    for name in ("png", "jpeg", "cmyk jpeg", "16 bits", "palette", "alpha", "bmp", "tiff", "webp"):
        assert decode_image(IMAGES[name], Path(name), color=True).shape == (12, 16, 3), name
