"""A TUM trajectory beside images or a video: pairing by names, times and frame numbers."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.images import read_gray
from tests.data.helpers import make_image


def write_trajectory(path: Path, rows: list[tuple[float, float]]) -> None:
    """Poses without rotation at these times and x."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ["# timestamp tx ty tz qx qy qz qw", *(f"{time:.6f} {x} 0 0 0 0 0 1" for time, x in rows)]
    path.write_text("\n".join(lines) + "\n")


def write_video(path: Path, count: int, rate: float = 10) -> None:
    """Frames that are brighter one after the other."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate, (64, 48))
    for i in range(count):
        writer.write(np.full((48, 64, 3), 20 + 20 * i, np.uint8))
    writer.release()


def load(root: Path) -> list[tuple[str, float, float | None]]:
    """Name of the image, x and time of each frame."""
    scene = load_scene(root, val_fraction=0, test_fraction=0)
    assert (scene.format, scene.unit) == ("trajectory", "m")
    return [(frame.image.name, frame.position_m[0], frame.timestamp) for frame in scene.frames]


@pytest.mark.parametrize("folder", ["", "rgb", "images"])
def test_images_have_the_pose_of_the_time_in_their_name(folder: str, tmp_path: Path) -> None:
    for time in ("100.00", "100.10", "100.20"):
        make_image(tmp_path / folder / f"img_{time}.png")
    write_trajectory(tmp_path / "trajectory.txt", [(100.201, 3), (100.001, 1), (100.15, 9)])
    assert load(tmp_path) == [("img_100.00.png", 1, 100.0), ("img_100.20.png", 3, 100.2)]


def test_times_in_names_may_be_nanoseconds(tmp_path: Path) -> None:
    for time in (1403636579763555584, 1403636579813555456):
        make_image(tmp_path / "data" / f"{time}.png")
    write_trajectory(tmp_path / "CameraTrajectory.txt", [(1403636579.763556, 1), (1403636579.813555, 2)])
    assert [x for _, x, _ in load(tmp_path)] == [1, 2]


def test_names_in_comments_come_before_times(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        make_image(tmp_path / name)
    (tmp_path / "walk.tum").write_text(
        "# timestamp tx ty tz qx qy qz qw\n# folder/b.png\n0 2 0 0 0 0 0 1\n# a.png\n1 1 0 0 0 0 0 1\n"
    )
    assert load(tmp_path) == [("b.png", 2, None), ("a.png", 1, None)]


@pytest.mark.parametrize(
    "times", [[0.0, 0.201, 0.4], [0, 2, 4], [1.6e9, 1.6e9 + 0.2, 1.6e9 + 0.4]], ids=["seconds", "numbers", "clock"]
)
def test_frames_of_a_video(times: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIGHTNING_POSE_CACHE", str(tmp_path / "cache"))
    root = tmp_path / "walk"
    root.mkdir()
    write_video(root / "walk.avi", 6)
    write_trajectory(root / "trajectory.txt", [(time, x) for x, time in enumerate(times)])
    scene = load_scene(root, val_fraction=0, test_fraction=0)
    brightness = [read_gray(frame.image).mean() for frame in scene.frames]
    np.testing.assert_allclose(brightness, [20, 60, 100], atol=4)
    np.testing.assert_allclose([frame.position_m[0] for frame in scene.frames], [0, 1, 2])


def test_a_trajectory_in_a_dataset_is_no_dataset(tmp_path: Path) -> None:
    make_image(tmp_path / "a.png")
    (tmp_path / "poses.csv").write_text("image,tx,ty,tz,qw,qx,qy,qz\na.png,1,0,0,1,0,0,0\n")
    write_trajectory(tmp_path / "answers.tum", [(0, 5)])
    assert load_scene(tmp_path, val_fraction=0, test_fraction=0).format == "pose_list"


def test_images_without_poses_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for time in (1.0, 2.0, 3.0):
        make_image(tmp_path / f"{time:.1f}.png")
    write_trajectory(tmp_path / "trajectory.txt", [(1.0, 1)])
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        assert len(load(tmp_path)) == 1
    assert "dropped 2 of 3 images, no pose within 20 ms of the time in their name" in caplog.text


def test_other_clocks_are_refused(tmp_path: Path) -> None:
    make_image(tmp_path / "5.0.png")
    write_trajectory(tmp_path / "trajectory.txt", [(1000.0, 1), (1001.0, 1)])
    with pytest.raises(DataError, match=r"none of the images has a pose in trajectory.txt, whose times are 1000\.0"):
        load_scene(tmp_path)


def test_two_trajectories_are_refused(tmp_path: Path) -> None:
    make_image(tmp_path / "5.0.png")
    for name in ("a.tum", "b.tum"):
        write_trajectory(tmp_path / name, [(5.0, 1)])
    with pytest.raises(DataError, match=r"needs one trajectory, and images or one video; it has a.tum, b.tum"):
        load_scene(tmp_path, "trajectory")
