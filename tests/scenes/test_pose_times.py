"""Poses at the images' times: what they are, which frames are dropped, and how the ground truth is named."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.scenes.pose_times import check_pose_time, interpolate_scene
from lightning_pose.scenes.scene import Frame, Scene, Trajectory

IDENTITY = np.array([1.0, 0, 0, 0])


def make_scene(image_times: list[float], pose_times: np.ndarray) -> Scene:
    """A camera that moves by 1 m and turns by 10 degrees in a second; images have the pose at the origin so far."""
    quats = Rotation.from_euler("z", 10 * pose_times[:, None], degrees=True).as_quat(scalar_first=True)
    trajectory = Trajectory(pose_times, np.column_stack([pose_times, 0 * pose_times, 0 * pose_times]), quats)
    frames = [Frame(Path(f"{i}.png"), np.zeros(3), IDENTITY, "walk", i, t) for i, t in enumerate(image_times)]
    last = len(frames) - 1
    splits = {"train": np.arange(last), "val": np.array([], int), "test": np.array([last])}
    return Scene("walk", Path("walk"), "tum", tuple(frames), splits, trajectory=trajectory)


def test_an_image_has_the_pose_of_its_time_and_the_offset() -> None:
    found = interpolate_scene(make_scene([0.33, 0.55], np.linspace(0, 1, 11)), -20.0)
    np.testing.assert_allclose([frame.position_m[0] for frame in found.frames], [0.31, 0.53])
    turns = Rotation.from_quat([frame.quat_wxyz for frame in found.frames], scalar_first=True)
    np.testing.assert_allclose(turns.as_euler("xyz", degrees=True)[:, 2], [3.1, 5.3])
    assert found.ground_truth == "original, interpolated at -20 ms"


def test_poses_that_are_interpolated_already_get_the_other_offset() -> None:
    scene = interpolate_scene(make_scene([0.33, 0.55], np.linspace(0, 1, 11)), 0.0)
    assert scene.ground_truth == "original, interpolated"
    again = interpolate_scene(scene, 10.0)
    np.testing.assert_allclose(again.frames[0].position_m[0], 0.34)
    assert again.ground_truth == "original, interpolated at +10 ms"


def test_frames_outside_the_trajectory_and_in_its_holes_are_dropped(caplog: pytest.LogCaptureFixture) -> None:
    pose_times = np.delete(np.linspace(0, 1, 11), [4, 5, 6])
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        found = interpolate_scene(make_scene([0.05, 0.5, 0.95, 1.05, 0.25], pose_times), 0.0)
    assert "dropped 2 of 5 images, no poses around their time" in caplog.text
    assert [frame.index for frame in found.frames] == [0, 2, 4]
    assert {split: indices.tolist() for split, indices in found.splits.items()} == {
        "train": [0, 1],
        "val": [],
        "test": [2],
    }


def test_scenes_without_poses_by_time_are_refused() -> None:
    scene = make_scene([0.1, 0.2], np.linspace(0, 1, 11))
    for other in (replace(scene, trajectory=None), replace(scene, frames=(replace(scene.frames[0], timestamp=None),))):
        with pytest.raises(ConfigError, match=r"walk \(tum\) has no poses by time of one recording; set nearest"):
            interpolate_scene(other, 0.0)
    with pytest.raises(DataError, match="no image lies within the times of the poses at 5000 ms"):
        interpolate_scene(scene, 5000.0)


@pytest.mark.parametrize(
    ("pose_time", "offset", "problem"),
    [
        ("between", 0.0, r"pose_time is 'between'; give nearest or interpolate"),
        ("interpolate", "found", r"clock_offset_ms is 'found'; give milliseconds, such as -10, or auto"),
        ("interpolate", float("nan"), r"clock_offset_ms is nan"),
        ("nearest", "auto", r"clock_offset_ms is auto, but data.pose_time is nearest.*set interpolate"),
    ],
)
def test_settings_that_make_no_sense_are_refused(pose_time: str, offset: float | str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        check_pose_time(pose_time, offset)
