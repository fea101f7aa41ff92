"""12-Scenes: the first sequence is the test split, frames that were not tracked are dropped, the camera is read."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.scene import Intrinsics
from tests.data.helpers import QUARTER_TURN_Z, make_image

INFO = """m_versionNumber = 4
m_sensorName = StructureSensor
m_colorWidth = 1296
m_colorHeight = 968
m_calibrationColorIntrinsic = 1158.3 0 649 0 0 1153.53 483.5 0 0 0 1 0 0 0 0 1
"""
SPLIT = "sequence0 [frames=3]  [start=0 ; end=2]\nsequence1 [frames=4]  [start=3 ; end=6]\n"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Frame i stands at (i, 0, 0), turned a quarter about z."""
    root = tmp_path / "kitchen"
    for i in range(7):
        stem = make_image(root / "data" / f"frame-{i:06d}.color.jpg").with_name(f"frame-{i:06d}")
        make_image(stem.with_suffix(".depth.png"))
        T_world_cam = np.eye(4)
        T_world_cam[:3, :3] = QUARTER_TURN_Z
        T_world_cam[0, 3] = i
        np.savetxt(stem.with_suffix(".pose.txt"), T_world_cam)
    (root / "info.txt").write_text(INFO)
    (root / "split.txt").write_text(SPLIT)
    return root


def test_first_sequence_is_the_test_split(root: Path) -> None:
    scene = load_scene(root, val_fraction=0)
    assert (scene.name, scene.format, scene.split_source, scene.unit) == ("kitchen", "12scenes", "official", "m")
    np.testing.assert_array_equal(scene.splits["test"], [0, 1, 2])
    np.testing.assert_array_equal(scene.splits["train"], [3, 4, 5, 6])
    frame = scene.frames[4]
    assert (frame.sequence, frame.index) == ("sequence1", 4)
    assert frame.image == root / "data" / "frame-000004.color.jpg"
    np.testing.assert_allclose(frame.position_m, [4, 0, 0])
    np.testing.assert_allclose(frame.quat_wxyz, [0.5**0.5, 0, 0, 0.5**0.5])
    assert frame.intrinsics == Intrinsics(fx=1158.3, fy=1153.53, cx=649, cy=483.5)


@pytest.mark.parametrize("entry", ["INF", "-INF", "-1.#INF", "nan"])
def test_frames_that_were_not_tracked_are_dropped(entry: str, root: Path, caplog: pytest.LogCaptureFixture) -> None:
    (root / "data" / "frame-000005.pose.txt").write_text(f"{entry} {entry} {entry} {entry}\n" * 4)
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        scene = load_scene(root)
    assert "dropped 1 of 7 frames, poses with infinite entries: not tracked" in caplog.text
    assert [f.index for f in scene.frames] == [0, 1, 2, 3, 4, 6]


def test_frames_beyond_the_sequences_are_dropped_with_a_count(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    (root / "split.txt").write_text(SPLIT.replace("end=6", "end=5"))
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        assert len(load_scene(root).frames) == 6
    assert "dropped 1 of 7 frames that are in no sequence of split.txt" in caplog.text


def test_other_faults_are_the_users_choice(root: Path) -> None:
    (root / "data" / "frame-000005.pose.txt").unlink()
    with pytest.raises(DataError, match=r"1 of 7 frames cannot be used: .*000005.color.jpg has no .pose.txt"):
        load_scene(root)
    assert len(load_scene(root, on_bad_frame="drop").frames) == 6


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("split.txt", "seq-01\n", r"split.txt:1: expected `sequenceN \[frames=COUNT\]"),
        ("split.txt", SPLIT.splitlines()[0], r"split.txt lists 1 sequences; it needs one to test on"),
        ("split.txt", f"sequence0 [frames=1] [start=0 ; end={'9' * 5000}]", r"split.txt:1: expected"),
        ("info.txt", "m_colorWidth = 1296\n", r"info.txt has no line `m_calibrationColorIntrinsic = `"),
        ("info.txt", INFO.replace("649 0", "649"), r"info.txt:5: expected 16 numbers of a camera matrix"),
        ("info.txt", INFO.replace("1158.3", "nan"), r"info.txt:5: expected 16 numbers of a camera matrix"),
    ],
)
def test_malformed_files_are_refused(root: Path, file: str, text: str, message: str) -> None:
    (root / file).write_text(text)
    with pytest.raises(DataError, match=message):
        load_scene(root)
