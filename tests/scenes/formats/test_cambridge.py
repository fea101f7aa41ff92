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


def test_forced_on_another_folder_names_the_missing_lists(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"has no dataset_train.txt and dataset_test.txt"):
        load_scene(tmp_path, format="cambridge")


@pytest.mark.parametrize("header", ["", "ImageFile, Camera Position [X Y Z W P Q R]\n", "# made by hand\n", HEADER])
def test_a_line_that_parses_as_data_is_data(header: str, tmp_path: Path) -> None:
    write(tmp_path, TRAIN, TEST)
    for file in ("dataset_train.txt", "dataset_test.txt"):
        path = tmp_path / file
        path.write_text(path.read_text().replace(HEADER, header))
    assert len(load_scene(tmp_path).frames) == 4


def test_header_gives_the_order_of_the_quaternion(tmp_path: Path) -> None:
    write(tmp_path, [f"seq1/frame0000{i}.png 4 5 6 {HALF} 0 0 {HALF}" for i in (2, 3)], TEST)
    path = tmp_path / "dataset_train.txt"
    path.write_text(path.read_text().replace("W P Q R", "P Q R W"))
    np.testing.assert_allclose(load_scene(tmp_path).frames[1].quat_wxyz, [HALF, -HALF, 0, 0], atol=1e-12)


@pytest.mark.parametrize("separator", [",", ", ", "\t", ";"])
def test_separators(separator: str, tmp_path: Path) -> None:
    write(tmp_path, TRAIN, TEST)
    for file in ("dataset_train.txt", "dataset_test.txt"):
        path = tmp_path / file
        path.write_text(HEADER + path.read_text()[len(HEADER) :].replace(" ", separator))
    np.testing.assert_allclose(load_scene(tmp_path).frames[-1].position_m, [4, 5, 6])


def test_blanks_in_names(tmp_path: Path) -> None:
    write(tmp_path, TRAIN, TEST)
    for path in (tmp_path / "dataset_train.txt", tmp_path / "dataset_test.txt"):
        path.write_text(path.read_text().replace("/frame", " a/my frame "))
    for image in tmp_path.glob("seq*/*.png"):
        make_image(tmp_path / f"{image.parent.name} a" / image.name.replace("frame", "my frame "))
    assert load_scene(tmp_path).frames[-1].sequence == "seq10 a"


def test_names_that_begin_with_a_date_are_numbered_in_order(tmp_path: Path) -> None:
    times = (103052, 103059, 103106, 235959)
    rows = [f"seq1/img_20190415_{t}.png {i} 0 0 1 0 0 0" for i, t in enumerate(times)]
    frames = load_scene(write(tmp_path, rows, ["seq2/img_20190415_120000.png 0 0 0 1 0 0 0"]), val_fraction=0).frames
    assert [(f.sequence, f.index) for f in frames] == [*[("seq1", i) for i in range(4)], ("seq2", 0)]
    np.testing.assert_allclose([f.position_m[0] for f in frames[:4]], range(4))


def test_bad_frames_are_dropped_with_their_count(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bad = ["seq2/frame00013.png nan 0 0 1 0 0 0", "seq2/frame00014.png 0 0 0 0 0 0 0", "seq2/frame00015.png 1 2 3"]
    write(tmp_path, [*TRAIN, *bad], TEST)
    (tmp_path / "seq2" / "frame00003.png").unlink()
    with pytest.raises(DataError, match=r"4 of 7 frames cannot be used: .*frame00003.png is missing.*train.txt:7: "):
        load_scene(tmp_path)
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        scene = load_scene(tmp_path, on_bad_frame="drop", val_fraction=0)
    assert "4 of 7 frames cannot be used" in caplog.text
    np.testing.assert_array_equal(scene.splits["train"], [1, 2])


def test_nothing_left_of_a_split_is_refused(tmp_path: Path) -> None:
    write(tmp_path, TRAIN, ["seq1/frame00001.png nan 8 9 1 0 0 0"])
    with pytest.raises(DataError, match=r"no usable frame for the test split; 1 of 4 frames cannot be used"):
        load_scene(tmp_path, on_bad_frame="drop")


def test_lines_gone_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    make_image(write(tmp_path, TRAIN, TEST) / "seq2" / "frame00099.png")
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        load_scene(tmp_path)
    assert "1 of 3 images are not in dataset_train.txt or dataset_test.txt" in caplog.text


@pytest.mark.parametrize(
    ("names", "splits"),
    [
        (("chess_train.txt", "chess_val.txt"), {"train": 3, "val": 0, "test": 1}),
        (("train.txt", "test.txt"), {"train": 3, "val": 0, "test": 1}),
        (("Chess-Train.txt", "Chess-Validation.txt"), {"train": 3, "val": 0, "test": 1}),
    ],
)
def test_lists_of_another_name_are_read(tmp_path: Path, names: tuple[str, str], splits: dict[str, int]) -> None:
    write(tmp_path, TRAIN, TEST)
    for old, new in zip(("dataset_train.txt", "dataset_test.txt"), names, strict=True):
        (tmp_path / old).rename(tmp_path / new)
    scene = load_scene(tmp_path, val_fraction=0)
    assert {split: len(rows) for split, rows in scene.splits.items()} == splits


def test_val_list_beside_a_test_list_is_the_validation_split(tmp_path: Path) -> None:
    write(tmp_path, TRAIN, TEST)
    (tmp_path / "dataset_val.txt").write_text(HEADER + "seq3/frame00001.png 1 1 1 1 0 0 0\n")
    make_image(tmp_path / "seq3/frame00001.png")
    scene = load_scene(tmp_path)
    assert [scene.frames[i].sequence for i in scene.splits["val"]] == ["seq3"]


def test_lists_without_poses_are_not_of_this_format(tmp_path: Path) -> None:
    for name in ("train.txt", "test.txt"):
        (tmp_path / name).write_text("a.png\nb.png\n")
    with pytest.raises(DataError, match="known format"):
        load_scene(tmp_path)
