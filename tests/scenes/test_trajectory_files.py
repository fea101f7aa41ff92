"""TUM files: column order, scalar last, one file per sequence."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface

from lightning_pose.scenes.scene import Frame
from lightning_pose.scenes.trajectory_files import write_sequences, write_tum

POSITIONS = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]])
QUATS_WXYZ = np.array([[1.0, 0.0, 0.0, 0.0], [0.5, 0.5, -0.5, 0.5], [0.0, 0.6, 0.8, 0.0]])


def frame(sequence: str, index: int, timestamp: float | None = None, image: str = "x.png") -> Frame:
    return Frame(Path(image), np.zeros(3), np.array([1.0, 0, 0, 0]), sequence, index, timestamp)


def test_columns(tmp_path: Path) -> None:
    file = tmp_path / "new" / "poses.tum"
    write_tum(file, [0.5, 1305031102.175304, 2.0], POSITIONS, QUATS_WXYZ)
    assert file.read_text().splitlines()[0] == "# timestamp tx ty tz qx qy qz qw"
    rows = np.loadtxt(file)
    np.testing.assert_allclose(rows[:, 0], [0.5, 1305031102.175304, 2.0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(rows[1, 1:], [4, 5, 6, 0.5, -0.5, 0.5, 0.5])
    np.testing.assert_allclose(rows[:, 7], QUATS_WXYZ[:, 0])


def test_one_file_per_sequence_with_time_or_number(tmp_path: Path) -> None:
    frames = [frame("walk/a", 7), frame("b", 3, timestamp=0.25), frame("walk/a", 9)]
    files = write_sequences(tmp_path, frames, POSITIONS, QUATS_WXYZ)
    assert [file.name for file in files] == ["walk_a.tum", "b.tum"]
    np.testing.assert_allclose(np.loadtxt(files[0])[:, :4], [[7, 1, 2, 3], [9, 7, 8, 9]])
    np.testing.assert_allclose(np.loadtxt(files[1])[:4], [0.25, 4, 5, 6])


def test_each_pose_has_the_name_of_its_image(tmp_path: Path) -> None:
    frames = [
        frame("walk", 0, image="room/walk/img_20190415_103000.png"),
        frame("walk", 1, image="room/walk/img_20190415_103007.png"),
        frame("two", 0, image="room/two/left/a b.png"),
        frame("two", 1, image="room/two/right/1.png"),
    ]
    poses = np.concatenate([POSITIONS, POSITIONS[:1]]), np.concatenate([QUATS_WXYZ, QUATS_WXYZ[:1]])
    walk, two = (file.read_text().splitlines() for file in write_sequences(tmp_path, frames, *poses))
    assert walk[1:4:2] == ["# img_20190415_103000.png", "# img_20190415_103007.png"]
    assert two[1:4:2] == ["# left/a b.png", "# right/1.png"]
    np.testing.assert_allclose(np.loadtxt(tmp_path / "walk.tum")[:, 0], [0, 1])


def test_refused_poses_are_left_out_with_a_comment(tmp_path: Path) -> None:
    frames = [frame("walk", i, image=f"room/walk/{i}.png") for i in range(3)]
    (file,) = write_sequences(tmp_path, frames, POSITIONS, QUATS_WXYZ, np.array([False, True, False]))
    assert [line for line in file.read_text().splitlines() if ".png" in line] == [
        "# 0.png",
        "# 1.png refused",
        "# 2.png",
    ]
    np.testing.assert_allclose(np.loadtxt(file)[:, 0], [0, 2])


def test_equal_times_become_numbers_of_frames(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    frames = [frame("walk", i, timestamp=1600000000.0 + 1e-7 * i) for i in range(3)]
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        (file,) = write_sequences(tmp_path, frames, POSITIONS, QUATS_WXYZ)
    np.testing.assert_allclose(np.loadtxt(file)[:, 0], [0, 1, 2])
    assert "walk: two frames have the same time" in caplog.text


def test_evo_reads_it(tmp_path: Path) -> None:
    frames = [frame("walk", i, timestamp=float(i)) for i in range(3)]
    (file,) = write_sequences(tmp_path, frames, POSITIONS, QUATS_WXYZ)
    read = file_interface.read_tum_trajectory_file(file)
    np.testing.assert_allclose(read.positions_xyz, POSITIONS)
    np.testing.assert_allclose(read.orientations_quat_wxyz, QUATS_WXYZ)
