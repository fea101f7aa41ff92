"""COLMAP models, text and binary: poses are inverted, the half pixel is taken off, each frame has its camera."""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.scene import Intrinsics
from tests.data.helpers import make_image

FISHEYE = (300.0, 300.0, 400.0, 300.0, 0.1, 0.2, 0.3, 0.4)
CAMERAS = ((1, "PINHOLE", 1, 640, 480, (500.0, 510.0, 320.0, 240.0)), (7, "OPENCV_FISHEYE", 5, 800, 600, FISHEYE))
"""Number, model, the model's number, width, height and parameters."""

IMAGES = (
    (3, (0.5**0.5, 0.0, 0.0, 0.5**0.5), (1.0, 2.0, 3.0), 7, "b 1.jpg"),
    (2, (1.0, 0.0, 0.0, 0.0), (1.0, 2.0, 3.0), 1, "a.jpg"),
)
"""Number, world-to-camera quaternion wxyz and translation, camera and name."""


def write_text(folder: Path) -> None:
    folder.mkdir(parents=True)
    lines = ["# Camera list with one line of data per camera:"]
    lines += [f"{number} {model} {w} {h} {' '.join(map(str, values))}" for number, model, _, w, h, values in CAMERAS]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list with two lines of data per image:"]
    for number, quat, translation, camera, name in IMAGES:
        lines += [" ".join(map(str, (number, *quat, *translation, camera, name))), "1.5 2.5 -1" if number == 3 else ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")


def write_binary(folder: Path) -> None:
    folder.mkdir(parents=True)
    data = struct.pack("<Q", len(CAMERAS))
    for number, _, kind, width, height, values in CAMERAS:
        data += struct.pack(f"<iiQQ{len(values)}d", number, kind, width, height, *values)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(IMAGES))
    for number, quat, translation, camera, name in IMAGES:
        data += struct.pack("<i7di", number, *quat, *translation, camera) + name.encode() + b"\0"
        data += struct.pack("<Q", 1) + struct.pack("<ddq", 1.5, 2.5, -1)
    (folder / "images.bin").write_bytes(data)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = tmp_path / "hall"
    for name in ("a.jpg", "b 1.jpg"):
        make_image(root / "images" / name)
    return root


@pytest.mark.parametrize("write", [write_text, write_binary])
@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
def test_known_values(write: Callable[[Path], None], place: str, root: Path) -> None:
    model = root / place if place != "." else root / "model"
    write(model)
    scene = load_scene(root, val_fraction=0, test_fraction=0)
    assert (scene.format, scene.unit, scene.ground_truth) == ("colmap", "scene", "sfm")
    first, second = scene.frames
    assert (first.image, second.image) == (root / "images" / "a.jpg", root / "images" / "b 1.jpg")
    np.testing.assert_allclose(first.position_m, [-1, -2, -3])
    # world-to-camera turns by 90 degrees about z, so the centre is -R^T t = -(2, -1, 3)
    np.testing.assert_allclose(second.position_m, [-2, 1, -3], atol=1e-12)
    np.testing.assert_allclose(second.quat_wxyz, [0.5**0.5, 0, 0, -(0.5**0.5)], atol=1e-12)
    assert first.intrinsics == Intrinsics(500, 510, 319.5, 239.5, (640, 480))
    assert second.intrinsics == Intrinsics(300, 300, 399.5, 299.5, (800, 600), (0.1, 0.2, 0.3, 0.4), fisheye=True)


def test_the_model_with_the_most_photos_is_read(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_text(root / "sparse" / "1")
    write_text(root / "sparse" / "0")
    images = root / "sparse" / "0" / "images.txt"
    images.write_text("\n".join(images.read_text().splitlines()[:3]) + "\n")
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        assert len(load_scene(root, val_fraction=0, test_fraction=0).frames) == 2
    assert "holds 2 models" in caplog.text


def test_photos_in_folders_are_sequences(root: Path) -> None:
    write_text(root / "sparse")
    images = root / "sparse" / "images.txt"
    images.write_text(images.read_text().replace("a.jpg", "left/1.jpg").replace("b 1.jpg", "right/1.jpg"))
    for name in ("left/1.jpg", "right/1.jpg"):
        make_image(root / "images" / name)
    scene = load_scene(root, val_fraction=0, test_fraction=0)
    assert [frame.sequence for frame in scene.frames] == ["hall/left", "hall/right"]
    assert [frame.image.parent.name for frame in scene.frames] == ["left", "right"]


def test_a_lens_that_is_not_read_leaves_the_camera_unknown(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_text(root / "sparse")
    cameras = root / "sparse" / "cameras.txt"
    cameras.write_text(cameras.read_text().replace("7 OPENCV_FISHEYE", "7 EUCM"))
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        scene = load_scene(root, val_fraction=0, test_fraction=0)
    assert scene.frames[1].intrinsics is None
    assert "camera 7 is of model EUCM, whose distortion is not read; undistort the photos" in caplog.text


def test_lenses_that_opencv_does_not_have_are_read(root: Path) -> None:
    write_text(root / "sparse")
    cameras = root / "sparse" / "cameras.txt"
    cameras.write_text("1 FOV 640 480 300 300 320 240 0.9\n7 THIN_PRISM_FISHEYE 800 600 1 2 3 4 1 2 3 4 5 6 7 8\n")
    first, second = (frame.intrinsics for frame in load_scene(root, val_fraction=0, test_fraction=0).frames)
    assert first == Intrinsics(300, 300, 319.5, 239.5, (640, 480), (0.9,), fisheye=True)
    assert second == Intrinsics(1, 2, 2.5, 3.5, (800, 600), (1, 2, 3, 4, 5, 6, 7, 8), fisheye=True)


def test_missing_photos_are_named(root: Path) -> None:
    write_text(root / "sparse")
    (root / "images" / "a.jpg").unlink()
    with pytest.raises(DataError, match=r"1 of 2 frames cannot be used: .*a\.jpg is missing, listed in images\.txt"):
        load_scene(root, val_fraction=0, test_fraction=0)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin"])
def test_files_that_are_cut_short(file: str, root: Path) -> None:
    write_binary(root / "sparse")
    path = root / "sparse" / file
    data = path.read_bytes()
    for length in range(0, len(data), 7):
        path.write_bytes(data[:length])
        with pytest.raises(DataError, match=rf"{file} ends at byte {length}, in the middle of an entry"):
            load_scene(root, val_fraction=0, test_fraction=0)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("cameras.txt", "640", "x", r"cameras.txt:2: expected `CAMERA_ID MODEL"),
        ("cameras.txt", "500.0", "-5", r"focal lengths must be above 0"),
        ("images.txt", "3.0 1 a.jpg", "a.jpg", r"images.txt:4: expected `IMAGE_ID QW"),
        ("images.txt", "3.0 1 a.jpg", "3.0 9 a.jpg", r"a.jpg has camera 9, which the cameras file lacks"),
        ("images.txt", "2 1.0 0.0", "2 9.0 0.0", r"a.jpg: the quaternion's norm is 9"),
    ],
)
def test_faults_in_text(file: str, old: str, new: str, message: str, root: Path) -> None:
    write_text(root / "sparse")
    path = root / "sparse" / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(DataError, match=message):
        load_scene(root, val_fraction=0, test_fraction=0)
