"""The offset of the clocks is found on a recording's images, and the data module's poses are those at its times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightning_pose.data import ImageDataModule
from lightning_pose.errors import DataError
from lightning_pose.geometry.interpolation import interpolate_poses
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.synthetic import render_room
from tests.helpers import Thumbnails, write_scene

FRAME_S = 1 / 30
OFFSET_S = 0.015


def write_recording(root: Path, images: list[Path], position_m: np.ndarray, quat_wxyz: np.ndarray) -> Path:
    """A recording in TUM's layout, with poses at 200 Hz whose clock is ahead of the images'."""
    root.mkdir()
    frame_s = 100 + FRAME_S * np.arange(len(images))
    pose_s = np.arange(frame_s[0], frame_s[-1], 0.005)
    position_m, quat_wxyz = interpolate_poses(frame_s, position_m, quat_wxyz, pose_s)
    (root / "rgb.txt").write_text("".join(f"{t:.6f} {image}\n" for t, image in zip(frame_s, images, strict=True)))
    rows = np.column_stack([pose_s + OFFSET_S, position_m, quat_wxyz[:, 1:], quat_wxyz[:, 0]])
    np.savetxt(root / "groundtruth.txt", rows, fmt="%.9f")
    return root


def test_the_offset_is_found_on_training_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room = load_scene(render_room(tmp_path / "room", frames=90, size=(160, 120)))
    frames = [frame for frame in room.frames if frame.sequence == room.frames[0].sequence]
    position_m = np.array([frame.position_m for frame in frames])
    quats = np.array([frame.quat_wxyz for frame in frames])
    camera = room.frames[0].intrinsics
    assert camera is not None
    root = write_recording(tmp_path / "walk", [frame.image.absolute() for frame in frames], position_m, quats)
    data = ImageDataModule(
        Thumbnails(), str(root), pose_time="interpolate", clock_offset_ms="auto", cache_dir=str(tmp_path / "cache"),
        camera=f"PINHOLE,160,120,{camera.fx},{camera.fy},{camera.cx},{camera.cy}",
    )  # fmt: skip
    found = data.scene
    offset_ms = float(found.ground_truth.removeprefix("original, interpolated at ").removesuffix(" ms"))
    assert offset_ms == pytest.approx(1000 * OFFSET_S, abs=2)
    assert f"clocks: poses at {offset_ms:+.0f} ms of the images' times fit" in capsys.readouterr().out
    errors = [np.linalg.norm(frame.position_m - position_m[frame.index]) for frame in found.frames]
    step = np.median(np.linalg.norm(np.diff(position_m, axis=0), axis=1))
    assert np.median(errors) < 0.1 * step  # the nearest poses are off by half of a step


def test_images_without_matches_are_refused(tmp_path: Path) -> None:
    scene = load_scene(write_scene(tmp_path / "scene", train=(12,), test=3, size=(24, 24)))
    position_m, quats = np.zeros((len(scene.frames), 3)), np.tile([1.0, 0, 0, 0], (len(scene.frames), 1))
    root = write_recording(tmp_path / "walk", [frame.image.absolute() for frame in scene.frames], position_m, quats)
    data = ImageDataModule(Thumbnails(), str(root), pose_time="interpolate", clock_offset_ms="auto")
    with pytest.raises(
        DataError, match=r"too few training frames match each other.*give data.clock_offset_ms, such as 0"
    ):
        data.scene  # noqa: B018
