"""Heads of images: sizes without decoding, and what is refused; priors as text."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from PIL import Image

from lightning_pose.errors import ConfigError
from lightning_pose.localization.picture_head import NotAnImageError, TooManyPixelsError, check_head
from lightning_pose.localization.prior_text import parse_prior


@pytest.mark.parametrize("kind", [".png", ".jpg", ".webp", ".bmp", ".tiff", ".ppm"])
def test_the_size_is_read_of_each_kind(kind: str) -> None:
    data = cv2.imencode(kind, np.zeros((30, 40, 3), np.uint8))[1].tobytes()
    assert check_head(data, 1200) == (40, 30)
    with pytest.raises(TooManyPixelsError, match=r"more than 1,199 pixels \(40x30\)"):
        check_head(data, 1199)


def test_what_pillow_takes_for_a_bomb_is_too_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 500)
    data = cv2.imencode(".png", np.zeros((30, 40, 3), np.uint8))[1].tobytes()
    with pytest.raises(TooManyPixelsError, match="1,200"):
        check_head(data, 1200)


@pytest.mark.parametrize(
    "data", [b"", b"hello", b"/etc/passwd", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"GIF89a" + bytes(50)]
)
def test_what_is_no_image(data: bytes) -> None:
    with pytest.raises(NotAnImageError, match="JPEG, PNG"):
        check_head(data)


@pytest.mark.parametrize("text", ["", "1,2,3", "1,2,3,1,0,0,0,0", "a,b,c,1,0,0,0", "1,2,nan,1,0,0,0", "1,2,3,0,0,0,0"])
def test_a_prior_that_is_no_pose(text: str) -> None:
    with pytest.raises(ConfigError, match="x,y,z,qw,qx,qy,qz"):
        parse_prior(text)


def test_no_prior() -> None:
    assert parse_prior(None) is None
