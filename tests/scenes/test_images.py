"""Tests of image reading: kinds of pixels, stored orientation, and files that must be refused."""

from __future__ import annotations

import logging
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from lightning_pose.errors import ImageError
from lightning_pose.scenes.images import (
    ImageFacts,
    decode_image,
    find_bits,
    measure_image,
    read_bytes,
    read_gray,
    read_rgb,
    to_gray,
)
from tests.data.helpers import make_turned_jpeg

RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)
GRAY_OF = {RED: 76, GREEN: 150, BLUE: 29}  # 0.299, 0.587 and 0.114 of 255


def save(path: Path, image: np.ndarray) -> Path:
    """Write (H, W) or RGB(A) pixels."""
    order = {2: slice(None), 3: [2, 1, 0], 4: [2, 1, 0, 3]}[image.shape[2] if image.ndim == 3 else 2]
    assert cv2.imwrite(str(path), image if image.ndim == 2 else np.ascontiguousarray(image[..., order]))
    return path


def smooth(height: int = 48, width: int = 64) -> np.ndarray:
    rng = np.random.default_rng(0)
    return cv2.resize(rng.integers(0, 256, (6, 8, 3), np.uint8), (width, height))


def palette_png(indices: np.ndarray, palette: list[tuple[int, int, int]], alpha: bytes = b"") -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = indices.shape
    rows = b"".join(b"\0" + row.tobytes() for row in indices.astype(np.uint8))
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0))
        + chunk(b"PLTE", b"".join(map(bytes, palette)))
        + (chunk(b"tRNS", alpha) if alpha else b"")
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize(("color", "gray"), GRAY_OF.items())
def test_color(color: tuple[int, int, int], gray: int, tmp_path: Path) -> None:
    path = save(tmp_path / "x.png", np.full((4, 5, 3), color, np.uint8))
    rgb = read_rgb(path)
    assert (rgb.shape, rgb.dtype) == ((4, 5, 3), np.uint8)
    assert tuple(rgb[0, 0]) == color
    image = read_gray(str(path))
    assert (image.shape, image.dtype) == ((4, 5), np.uint8)
    assert np.all(image == gray)


def test_gray_is_expanded(tmp_path: Path) -> None:
    image = np.arange(20, dtype=np.uint8).reshape(4, 5)
    path = save(tmp_path / "x.png", image)
    np.testing.assert_array_equal(read_gray(path), image)
    np.testing.assert_array_equal(read_rgb(path), np.repeat(image[..., None], 3, axis=2))


def test_16_bits_are_scaled_by_their_full_range(tmp_path: Path) -> None:
    path = save(tmp_path / "x.png", np.array([[0, 255, 256, 0x7FFF, 0xFFFF]], np.uint16))
    np.testing.assert_array_equal(read_gray(path), [[0, 0, 1, 127, 255]])
    color = save(tmp_path / "y.png", np.array([[[0xFFFF, 0x8000, 0]]], np.uint16))
    np.testing.assert_array_equal(read_rgb(color), [[[255, 128, 0]]])


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_bits_in_use_are_scaled_to_8(bits: int, tmp_path: Path) -> None:
    top = (1 << bits) - 1
    image = np.array([[0, top // 2 + 1, top]], np.uint16)
    np.testing.assert_array_equal(read_gray(save(tmp_path / "x.png", image)), [[0, 128, 255]])
    np.testing.assert_array_equal(to_gray(image), [[0, 128, 255]])
    assert find_bits(image) == bits


def test_alpha_is_dropped(tmp_path: Path) -> None:
    path = save(tmp_path / "x.png", np.array([[(*RED, 0), (*GREEN, 128), (*BLUE, 255)]], np.uint8))
    np.testing.assert_array_equal(read_rgb(path), [[RED, GREEN, BLUE]])
    np.testing.assert_array_equal(read_gray(path), [list(GRAY_OF.values())])


@pytest.mark.parametrize("alpha", [b"", b"\x00\x80"], ids=["opaque", "transparent"])
def test_palette(alpha: bytes, tmp_path: Path) -> None:
    path = tmp_path / "x.png"
    path.write_bytes(palette_png(np.array([[0, 1, 2]]), [RED, GREEN, BLUE], alpha))
    np.testing.assert_array_equal(read_rgb(path), [[RED, GREEN, BLUE]])
    np.testing.assert_array_equal(read_gray(path), [list(GRAY_OF.values())])


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_exif_orientation_is_ignored(orientation: int, tmp_path: Path) -> None:
    plain = save(tmp_path / "x.jpg", smooth())
    turned = tmp_path / "turned.jpg"
    turned.write_bytes(make_turned_jpeg(smooth()[..., ::-1], orientation))
    if orientation != 3:  # OpenCV would apply the tag; `decode_image` asks it not to
        honoured = cv2.imread(str(turned))
        assert honoured is not None
        assert honoured.shape == (64, 48, 3)
    np.testing.assert_array_equal(read_gray(turned), read_gray(plain))
    np.testing.assert_array_equal(read_rgb(turned), read_rgb(plain))


@pytest.mark.parametrize(("order", "orientation"), [("<", 5), (">", 7)])
def test_exif_orientation_is_said_once(
    order: str, orientation: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    paths = [tmp_path / f"{i}.jpg" for i in range(2)]
    for path in paths:
        path.write_bytes(make_turned_jpeg(smooth(), orientation, order))
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        for path in paths:
            read_gray(path)
    assert caplog.text.count("has EXIF orientation") == 1
    assert (
        f"{paths[0]} has EXIF orientation {orientation}, which is ignored: poses refer to pixels as stored"
        in caplog.text
    )
    assert measure_image(paths[1].read_bytes(), paths[1]) == ImageFacts(64, 48, 8, orientation, False)


def test_damaged_exif_is_no_orientation() -> None:
    data = make_turned_jpeg(smooth(), 6)
    cut = data.replace(struct.pack("<HHIHH", 0x0112, 3, 1, 6, 0), struct.pack("<HHIHH", 0x0112, 3, 1, 600, 0))
    assert measure_image(cut, "x.jpg").orientation == 1
    assert measure_image(data.replace(b"II*\0\x08", b"II*\0\xff"), "x.jpg").orientation == 1


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".ppm", ".tif", ".webp"])
@pytest.mark.parametrize("kept", [0.02, 0.5, 0.98])
def test_truncated_is_refused(suffix: str, kept: float, tmp_path: Path) -> None:
    path = save(tmp_path / f"x{suffix}", smooth())
    assert read_gray(path).shape == (48, 64)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    for read in (read_gray, read_rgb):
        with pytest.raises(ImageError, match=rf"x\{suffix} is truncated or is not an image.*copy it again"):
            read(path)


def test_not_an_image(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "notes.jpg"
    path.write_text("no image")
    with pytest.raises(ImageError, match=r"notes\.jpg is truncated or is not an image.*8 bytes.*PNG or JPEG"):
        read_gray(path)
    assert capfd.readouterr().err == ""


def test_missing_empty_and_folder(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"gone\.png does not exist; check the path"):
        read_gray(tmp_path / "gone.png")
    with pytest.raises(ImageError, match="is a folder; give the path of one image file"):
        read_rgb(tmp_path)
    empty = tmp_path / "empty.png"
    empty.touch()
    with pytest.raises(ImageError, match=r"empty\.png is empty; copy"):
        read_bytes(empty)


def test_name_that_no_file_can_have(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match="cannot be read"):
        read_gray(tmp_path / ("x" * 5000))


def test_float_pixels_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "light.hdr", np.ones((4, 5, 3), np.float32))
    with pytest.raises(ImageError, match=r"light\.hdr holds float32 pixels; convert it to 8 or 16 bits"):
        read_gray(path)


def test_decode_names_the_path() -> None:
    with pytest.raises(ImageError, match=r"^a/b\.png is truncated"):
        decode_image(b"nothing", "a/b.png", color=True)


@pytest.mark.parametrize(
    "image",
    [
        np.full((2, 3), 128, np.uint8),
        np.full((2, 3, 1), 128, np.uint8),
        np.full((2, 3, 3), 128, np.uint8),
        np.full((2, 3, 4), 128, np.uint8),
        np.full((2, 3), 0x80FF, np.uint16),
        np.full((2, 3), 128 / 255, np.float32),
        np.full((2, 3, 3), 128 / 255, np.float64),
    ],
    ids=lambda image: f"{image.dtype}{image.shape}",
)
def test_to_gray(image: np.ndarray) -> None:
    gray = to_gray(image)
    assert (gray.shape, gray.dtype) == ((2, 3), np.uint8)
    assert np.all(gray == 128)


def test_to_gray_takes_rgb() -> None:
    np.testing.assert_array_equal(to_gray(np.array([[RED, GREEN, BLUE]], np.uint8)), [list(GRAY_OF.values())])


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_file_and_pixels_give_the_same_gray(suffix: str, tmp_path: Path) -> None:
    path = save(tmp_path / f"x{suffix}", smooth())
    np.testing.assert_array_equal(read_gray(path), to_gray(read_rgb(path)))


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((2, 3), np.int32), "a int32 image; give uint8"),
        (np.full((2, 3), 255.0), r"values 255\.\.255; scale it to 0\.\.1"),
        (np.full((2, 3), np.nan), "scale it to 0..1"),
        (np.zeros((2, 3, 2), np.uint8), r"shape \(2, 3, 2\); give"),
        (np.zeros((0, 3), np.uint8), r"shape \(0, 3\); give"),
        (np.zeros(3, np.uint8), r"shape \(3,\); give"),
    ],
)
def test_to_gray_refuses(image: np.ndarray, message: str) -> None:
    with pytest.raises(ImageError, match=message):
        to_gray(image)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "is a Git LFS pointer"),
        (b"\x00\x00\x00\x18ftypheic\x00\x00\x00\x00mif1heic", "is a HEIC photo"),
        (b"<!DOCTYPE html><html>", "is a web page"),
        (cv2.imencode(".tiff", np.zeros((8, 9), np.float32))[1].tobytes(), "holds float32 pixels"),
        (b"garbage", "is truncated or is not an image"),
    ],
)
def test_what_is_no_image_is_said(data: bytes, message: str) -> None:
    with pytest.raises(ImageError, match=message):
        decode_image(data, "a.jpg", color=False)
