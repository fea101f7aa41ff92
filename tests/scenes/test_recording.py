"""Warnings about recordings: repeated images, implausible speed, and poses of another camera than the images'."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightning_pose.scenes.recording import describe_pose_camera, inspect_recording
from lightning_pose.scenes.scene import Frame, Scene


def make_scene(steps_m: float = 0.01, format: str = "tum", ground_truth: str = "original", frames: int = 8) -> Scene:
    quat = np.array([1.0, 0, 0, 0])
    listed = tuple(
        Frame(Path(f"{i}.png"), np.array([i * steps_m, 0, 0]), quat, "room", i, 0.1 * i) for i in range(frames)
    )
    return Scene("room", Path("room"), format, listed, ground_truth=ground_truth)


def digests(text: str) -> list[bytes]:
    return [letter.strip(".").encode() for letter in text]


def test_a_sound_recording_has_no_warning() -> None:
    assert inspect_recording(make_scene(), digests("abcdefgh")) == []


def test_repeated_images_are_counted_with_those_that_have_another_pose() -> None:
    (text,) = inspect_recording(make_scene(), digests("abbbcddd"))
    assert text.startswith("4 frames repeat the image of the frame before them, up to 3 in a row, and 4 of them with")


def test_unreadable_images_are_no_repeats() -> None:
    assert inspect_recording(make_scene(), digests("........")) == []


def test_millimetres_per_second_are_implausible() -> None:
    (text,) = inspect_recording(make_scene(steps_m=10.0), digests("abcdefgh"))
    assert "moves at 100 m/s (median)" in text
    assert inspect_recording(make_scene(steps_m=4.0), digests("abcdefgh")) == []


def test_seven_scenes_poses_are_of_the_depth_camera() -> None:
    (text,) = describe_pose_camera(make_scene(format="7scenes"))
    assert "data.ground_truth=registered" in text
    for truth in ("registered", "sfm", "synthetic"):
        assert describe_pose_camera(make_scene(format="7scenes", ground_truth=truth)) == []
    assert describe_pose_camera(make_scene()) == []
