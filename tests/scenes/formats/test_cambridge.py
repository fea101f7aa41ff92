"""Cambridge Landmarks: world-to-camera quaternions beside camera centres, and lost poses."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats import load_scene
from tests.data.helpers import make_image

HEADER = "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"
HALF = 0.5**0.5


def write(root: Path, train: list[str], test: list[str]) -> Path:
    for file, rows in (("dataset_train.txt", train), ("dataset_test.txt", test)):
        (root / file).write_text(HEADER + "".join(f"{row}\n" for row in rows))
        for row in rows:
            make_image(root / row.split()[0])
    return root


TRAIN = [
    f"seq10/frame00002.png 4 5 6 {HALF} {HALF} 0 0",
    "seq2/frame00012.png 1 2 3 1 0 0 0",
    "seq2/frame00003.png 0 0 0 -1 0 0 0",
]
TEST = ["seq1/frame00001.png 7 8 9 1 0 0 0"]


def test_quaternion_is_inverted_and_the_centre_kept(tmp_path: Path) -> None:
    """World-to-camera turns 90 degrees about x: it takes the world's y to the camera's z.

    So the camera's z axis (forward) is the world's y: camera-to-world is (sqrt(1/2), -sqrt(1/2), 0, 0).
    """
    frame = load_scene(write(tmp_path, TRAIN, TEST)).frames[-1]
    np.testing.assert_allclose(frame.position_m, [4, 5, 6])
    np.testing.assert_allclose(frame.quat_wxyz, [HALF, -HALF, 0, 0], atol=1e-12)


def test_folder_is_the_sequence_and_order_is_natural(tmp_path: Path) -> None:
    scene = load_scene(write(tmp_path, TRAIN, TEST), val_fraction=0)
    assert [(f.sequence, f.index) for f in scene.frames] == [
        ("seq1", 1),
        ("seq2", 3),
        ("seq2", 12),
        ("seq10", 2),
    ]
    assert scene.frames[1].image == tmp_path / "seq2" / "frame00003.png"
    np.testing.assert_array_equal(scene.splits["train"], [1, 2, 3])
    np.testing.assert_array_equal(scene.splits["test"], [0])
    assert (scene.format, scene.ground_truth) == ("cambridge", "sfm")


def test_lost_pose_is_dropped_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(tmp_path, [*TRAIN, "seq2/frame00013.png 0 0 20000 1 0 0 0"], TEST)
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        scene = load_scene(tmp_path)
    assert len(scene.frames) == 4
    assert "dropped 1 of 5 frames" in caplog.text


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (
            "seq2/a1.png 1 2 3 1 0 0",
            r"dataset_train.txt:7: expected `image x y z qw qx qy qz`.*correct the line",
        ),
        ("seq2/a1.png 1 2 3 nan 0 0 0", r"dataset_train.txt:7: expected"),
        ("seq2/a1.png 1 2 3 9 0 0 0", r"dataset_train.txt:7: the quaternion's norm is 9.*check the order"),
        ("seq1/frame00001.png 1 2 3 1 0 0 0", r"dataset_test.txt:4: seq1/frame00001.png is listed twice"),
    ],
)
def test_bad_row_is_refused(tmp_path: Path, row: str, message: str) -> None:
    write(tmp_path, [*TRAIN, row], TEST)
    with pytest.raises(DataError, match=message):
        load_scene(tmp_path)


def test_empty_list_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"dataset_test.txt lists no usable frame; the test split needs"):
        load_scene(write(tmp_path, TRAIN, []))


def test_missing_image_is_named(tmp_path: Path) -> None:
    write(tmp_path, TRAIN, TEST)
    (tmp_path / "seq2" / "frame00003.png").unlink()
    with pytest.raises(DataError, match=r"1 of 4 frames.*frame00003.png is missing, listed in .*; unpack"):
        load_scene(tmp_path)


def test_forced_on_another_folder_names_the_missing_list(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"dataset_train.txt is missing"):
        load_scene(tmp_path, format="cambridge")
