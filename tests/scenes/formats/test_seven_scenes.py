"""7-Scenes: sequence names, poses, and what is refused."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.scene import Intrinsics
from tests.data.helpers import QUARTER_TURN_Z, REAL_DATA, write_seven_scenes

REDKITCHEN = REAL_DATA / "7scenes" / "redkitchen"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_seven_scenes(tmp_path / "chess", train={1: 4, 12: 4}, test={3: 2})


def set_pose(root: Path, matrix: np.ndarray, frame: int = 1) -> Path:
    path = root / "seq-12" / f"frame-{frame:06d}.pose.txt"
    np.savetxt(path, matrix, fmt="%.7e")
    return path


def turned(scale: float = 1.0) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = QUARTER_TURN_Z * scale
    return matrix


def test_reads_the_official_split_in_order(root: Path) -> None:
    scene = load_scene(root, val_fraction=0)
    assert (scene.name, scene.format, scene.unit, scene.ground_truth) == ("chess", "7scenes", "m", "original")
    assert [(f.sequence, f.index) for f in scene.frames] == [
        *[("seq-01", i) for i in range(4)],
        *[("seq-03", i) for i in range(2)],
        *[("seq-12", i) for i in range(4)],
    ]
    np.testing.assert_array_equal(scene.splits["train"], [0, 1, 2, 3, 6, 7, 8, 9])
    np.testing.assert_array_equal(scene.splits["test"], [4, 5])
    assert scene.splits["val"].size == 0


def test_pose_is_the_matrix_as_it_is(root: Path) -> None:
    frame = load_scene(root).frames[8]
    assert frame.image == root / "seq-12" / "frame-000002.color.png"
    np.testing.assert_allclose(frame.position_m, [2, 12, 0])
    np.testing.assert_allclose(frame.quat_wxyz, [0.5**0.5, 0, 0, 0.5**0.5], atol=1e-7)
    assert frame.position_m.dtype == frame.quat_wxyz.dtype == np.float64
    assert frame.intrinsics == Intrinsics(525, 525, 320, 240, size=(640, 480))


def test_accepts_jpeg(tmp_path: Path) -> None:
    root = write_seven_scenes(tmp_path, train={1: 3}, test={2: 1}, suffix="jpg")
    assert {f.image.suffix for f in load_scene(root).frames} == {".jpg"}


def test_synthetic_room_gives_its_camera(root: Path) -> None:
    camera = {"fx": 100, "fy": 101, "cx": 80, "cy": 60}
    (root / "synthetic.json").write_text(json.dumps({"seed": 0, "intrinsics": camera}))
    scene = load_scene(root)
    assert scene.ground_truth == "synthetic"
    assert scene.frames[0].intrinsics == Intrinsics(100, 101, 80, 60)


def test_synthetic_room_without_a_camera_is_refused(root: Path) -> None:
    (root / "synthetic.json").write_text("{}")
    with pytest.raises(DataError, match=r"synthetic\.json: no `intrinsics`.*render the room again"):
        load_scene(root)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sequence7\n", r"TestSplit.txt:1: `sequence7` is listed, but .*seq-07 is missing; unzip seq-07.zip"),
        ("seq 3\n", r"TestSplit.txt:1: expected `sequenceN`, found `seq 3`"),
        ("sequence3\nsequence12\n", r"TestSplit.txt:2: `sequence12` is also in TrainSplit.txt"),
        ("\n", r"TestSplit.txt is empty; list the test sequences"),
    ],
)
def test_bad_split_file_is_refused(root: Path, text: str, message: str) -> None:
    (root / "TestSplit.txt").write_text(text)
    with pytest.raises(DataError, match=message):
        load_scene(root)


def test_image_and_pose_must_come_together(root: Path) -> None:
    pose = root / "seq-12" / "frame-000001.pose.txt"
    text = pose.read_text()
    pose.unlink()
    with pytest.raises(DataError, match=r"frame-000001\.color\.png has no \.pose\.txt beside it; add it"):
        load_scene(root)
    pose.write_text(text)
    (root / "seq-12" / "frame-000001.color.png").unlink()
    with pytest.raises(DataError, match=r"frame-000001\.pose\.txt has no image beside it; add it"):
        load_scene(root)


def test_empty_sequence_is_refused(root: Path) -> None:
    for path in (root / "seq-03").iterdir():
        path.unlink()
    with pytest.raises(DataError, match=r"seq-03 has no frame-NNNNNN\.color\.png or \.jpg; unpack"):
        load_scene(root)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.full((4, 4), np.nan), r"NaN or infinite entries .*nan.*; remove the frame"),
        (np.diag([1, 1, 1, np.inf]), r"NaN or infinite entries .*inf"),
        (np.ones((4, 4)), r"last row is \[1. 1. 1. 1.\], not 0 0 0 1"),
        (turned(1.1), r"no rotation \(R\^T R is off by 0\.21\); correct the pose"),
        (np.diag([1.0, 1, -1, 1]), r"mirrored \(determinant -1.*\); give right-handed axes"),
        (np.eye(3), r"not a 4x4 matrix"),
    ],
)
def test_bad_pose_is_refused(root: Path, matrix: np.ndarray, message: str) -> None:
    path = set_pose(root, matrix)
    with pytest.raises(DataError, match=message) as caught:
        load_scene(root)
    assert str(path) in str(caught.value)


def test_rounded_rotation_becomes_the_nearest_one(root: Path) -> None:
    set_pose(root, turned(1.0005))
    quat = load_scene(root).frames[7].quat_wxyz
    np.testing.assert_allclose(quat, [0.5**0.5, 0, 0, 0.5**0.5], atol=1e-9)


def test_bad_frames_are_counted_and_dropped(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    set_pose(root, np.full((4, 4), -np.inf), 0)
    (root / "seq-12" / "frame-000001.pose.txt").unlink()
    (root / "seq-01" / "frame-000003.pose.txt").write_text("")
    pattern = r"3 of 10 frames .*seq-01/frame-000003.*seq-12/frame-000000.*seq-12/frame-000001.*data.on_bad_frame: drop"
    with pytest.raises(DataError, match=pattern):
        load_scene(root)
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        scene = load_scene(root, val_fraction=0, on_bad_frame="drop")
    assert "3 of 10 frames cannot be used" in caplog.text
    assert len(scene.bad_frames) == 3
    np.testing.assert_array_equal(scene.splits["train"], [0, 1, 2, 5, 6])
    np.testing.assert_array_equal(scene.splits["test"], [3, 4])


@pytest.mark.parametrize(
    "text",
    [
        "0,-1,0,2\n1,0,0,12\n0,0,1,0\n0,0,0,1\n",
        "\ufeff0\t-1\t0\t2\r\n1 0 0 12\r\n0 0 1 0\r\n",
        "[[0 -1 0 2] [1 0 0 12] [0 0 1 0]]",
    ],
)
def test_other_separators_and_three_rows(text: str, root: Path) -> None:
    (root / "seq-12" / "frame-000002.pose.txt").write_text(text)
    frame = load_scene(root).frames[8]
    np.testing.assert_allclose(frame.position_m, [2, 12, 0])
    np.testing.assert_allclose(frame.quat_wxyz, [0.5**0.5, 0, 0, 0.5**0.5], atol=1e-7)


def test_of_a_png_and_a_jpg_the_png_is_read(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    for image in root.glob("seq-*/*.png"):
        image.with_suffix(".jpg").touch()
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        assert {f.image.suffix for f in load_scene(root).frames} == {".png"}
    assert "4 frames have several images; frame-000000.color.png is read" in caplog.text


def test_upper_case_and_hidden_files(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    for image in root.glob("seq-*/*.png"):
        image.rename(image.with_suffix(".PNG"))
        (image.parent / f"._{image.name}").touch()
    for name in ("TrainSplit.txt", "TestSplit.txt"):
        (root / name).rename(root / name.lower())
        (root / f"._{name}").touch()
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        assert {f.image.suffix for f in load_scene(root).frames} == {".PNG"}
    assert "4 images are named as frame-000000.color.PNG and are read" in caplog.text


def test_split_files_may_name_folders(root: Path) -> None:
    (root / "TrainSplit.txt").write_text("seq-01\nseq-12\n")
    (root / "TestSplit.txt").write_text("seq-03\n")
    assert len(load_scene(root, val_fraction=0).splits["train"]) == 8


def test_without_split_files_blocks_are_held_out(root: Path) -> None:
    for name in ("TrainSplit.txt", "TestSplit.txt"):
        (root / name).unlink()
    scene = load_scene(root)
    assert (scene.format, scene.split_source, len(scene.frames)) == ("7scenes", "blocks", 10)
    assert len(scene.splits["test"])


def test_one_sequence_is_read(root: Path) -> None:
    scene = load_scene(root / "seq-12")
    assert (scene.format, scene.split_source) == ("7scenes", "blocks")
    assert [(f.sequence, f.index) for f in scene.frames] == [("seq-12", i) for i in range(4)]


def test_one_split_file_alone_is_refused(root: Path) -> None:
    (root / "TestSplit.txt").unlink()
    with pytest.raises(DataError, match=r"TestSplit.txt is missing"):
        load_scene(root)


def test_sequence_in_no_split_file_is_named(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    (root / "TrainSplit.txt").write_text("sequence1\n")
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        assert len(load_scene(root).frames) == 6
    assert "seq-12 have frames but are neither in TrainSplit.txt nor in TestSplit.txt" in caplog.text


def test_holes_in_the_numbers_are_said(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    for path in (root / "seq-12").glob("frame-000002.*"):
        path.unlink()
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        load_scene(root)
    assert "seq-12: the numbers of frames jump 1 times, first from 1 to 3" in caplog.text
    assert "seq-01: the numbers" not in caplog.text


def test_number_of_5000_digits_is_refused(root: Path) -> None:
    (root / "TestSplit.txt").write_text("sequence" + "3" * 5000)
    with pytest.raises(DataError, match=r"TestSplit.txt:1: expected `sequenceN`"):
        load_scene(root)
    (root / "TestSplit.txt").write_text("sequence3")
    set_pose(root, np.eye(4)).write_text("1 0 0 " + "9" * 5000 + " 0 1 0 0 0 0 1 0 0 0 0 1")
    with pytest.raises(DataError, match=r"frame-000001.pose.txt: the pose has NaN or infinite"):
        load_scene(root)


@pytest.mark.real_data
@pytest.mark.skipif(not REDKITCHEN.is_dir(), reason="redkitchen is not beside the checkout")
def test_redkitchen() -> None:
    scene = load_scene(REDKITCHEN)
    sizes = {split: len(indices) for split, indices in scene.splits.items()}
    assert sizes == {"train": 550, "val": 100, "test": 150}
    assert {scene.frames[i].sequence for i in scene.splits["test"]} == {"seq-03", "seq-08", "seq-13"}
    np.testing.assert_allclose(scene.frames[0].position_m, [-0.34045634, 0.016469818, 0.29656917], rtol=1e-7)
