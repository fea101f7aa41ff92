"""The command `check`: its output for a sound dataset, and the errors and warnings for others."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from lightning_pose.commands.check import main
from lightning_pose.errors import DataError
from tests.data.helpers import write_seven_scenes


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two training sequences and a test sequence of 10 frames, each frame another image of 160x120."""
    monkeypatch.setenv("COLUMNS", "300")
    write_seven_scenes(tmp_path, train={1: 10, 2: 10}, test={3: 10})
    rng = np.random.default_rng(0)
    for path in sorted(tmp_path.glob("seq-*/*.png")):
        noise = cv2.resize(rng.integers(0, 255, (30, 40, 3), np.uint8), (160, 120), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(path), noise)
    return tmp_path


def image(root: Path, sequence: int, frame: int) -> Path:
    return root / f"seq-{sequence:02d}" / f"frame-{frame:06d}.color.png"


def move(root: Path, sequence: int, frame: int, position_m: tuple[float, float, float]) -> None:
    path = image(root, sequence, frame).with_name(f"frame-{frame:06d}.pose.txt")
    T_world_cam = np.loadtxt(path)
    T_world_cam[:3, 3] = position_m
    np.savetxt(path, T_world_cam)


def test_sound_dataset(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(root)]) == 0
    printed = capsys.readouterr().out
    for text in (
        "30 frames",
        "7scenes, ground truth original",
        "train 18, val 2, test 10",
        "160x120",
        "9.00 x 2.00 x 0.00 m",
        "median 1 m, 0 deg",  # the spacing, and the test's distance from the sequence beside it
        "up to 2 m",  # validation took the frames beside the first two
        "usable as it is",
    ):
        assert text in printed
    assert "warning" not in printed


def test_unreadable_images_are_errors(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for frame in range(7):
        image(root, 1, frame).write_bytes(image(root, 1, frame).read_bytes()[:60])
    assert main([str(root)]) == 2
    printed = capsys.readouterr().out
    assert f"error: {image(root, 1, 0)} is truncated" in printed
    assert "error: 7 unreadable images in all" in printed
    assert "usable" not in printed


def test_copies_are_warned_of_above_all_across_the_split(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image(root, 1, 5).write_bytes(image(root, 1, 4).read_bytes())
    image(root, 3, 2).write_bytes(image(root, 2, 0).read_bytes())
    assert main([str(root)]) == 0
    printed = capsys.readouterr().out
    assert "warning: 2 images are copies of others" in printed
    assert "warning: 1 test images are also training or validation images" in printed
    assert f"{image(root, 3, 2)} is {image(root, 2, 0)}" in printed


def test_mixed_sizes_are_warned_of(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(image(root, 1, 0)), np.zeros((10, 12, 3), np.uint8))
    assert main([str(root)]) == 0
    assert "warning: images of 2 sizes, 160x120 (29), 12x10 (1); resize them" in capsys.readouterr().out


def test_jump_is_warned_of(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    move(root, 1, 9, (500, 0, 0))
    assert main([str(root)]) == 0
    printed = capsys.readouterr().out
    assert f"warning: {image(root, 1, 8)} to frame-000009.color.png: the pose jumps by 492 m and 0 deg" in printed


def test_camera_that_never_moves_is_an_error(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for sequence in (1, 2, 3):
        for frame in range(10):
            move(root, sequence, frame, (0, 0, 1))
    assert main([str(root)]) == 2
    assert "error: all 30 positions are [0. 0. 1.]; there is nothing to learn, check" in capsys.readouterr().out


def test_bad_frames_are_errors_and_what_drop_leaves_is_said(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for frame in (2, 5, 6, 7):
        image(root, 1, frame).with_name(f"frame-{frame:06d}.pose.txt").write_text("-inf " * 16)
    assert main([str(root)]) == 2
    printed = capsys.readouterr().out
    assert "error: 4 of 30 frames cannot be used: " in printed
    assert (
        "and 1 more; data.on_bad_frame: drop leaves them out, and 26 frames are left (train 14, val 2, test 10)"
        in printed
    )
    assert "usable as it is" not in printed


def test_brackets_in_names_are_shown(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    renamed = root.with_name("room[a]")
    root.rename(renamed)
    assert main([str(renamed)]) == 0
    assert "room[a]: 30 frames" in capsys.readouterr().out


def test_format_is_forced(root: Path) -> None:
    with pytest.raises(DataError, match="dataset_train"):
        main([str(root), "--format", "cambridge"])


def test_it_starts_without_torch() -> None:
    code = "import sys, lightning_pose.commands.check; sys.exit(bool({'torch', 'lightning'} & sys.modules.keys()))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_name_that_looks_like_markup_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = tmp_path / "room [a] [bold]b :smile:"
    root.mkdir()
    write_seven_scenes(root, train={1: 10, 2: 10}, test={3: 10})
    main([str(root)])
    assert "room [a] [bold]b :smile:: 30 frames" in capsys.readouterr().out
