"""TUM files: column order, scalar last, one file per sequence."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightning_pose.scenes.scene import Frame
from lightning_pose.scenes.trajectory_files import write_sequences, write_tum

POSITIONS = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]])
QUATS_WXYZ = np.array([[1.0, 0.0, 0.0, 0.0], [0.5, 0.5, -0.5, 0.5], [0.0, 0.6, 0.8, 0.0]])


def frame(sequence: str, index: int, timestamp: float | None = None) -> Frame:
    return Frame(Path("x.png"), np.zeros(3), np.array([1.0, 0, 0, 0]), sequence, index, timestamp)


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
