"""Visual odometry: known motions of projected points, a rendered room, and images that show nothing."""

from __future__ import annotations

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.evaluation.baselines import visual_odometry as module
from lightning_pose.evaluation.baselines.visual_odometry import (
    View,
    assume_intrinsics,
    match_motion,
    read_clip_poses,
    run_visual_odometry,
)
from lightning_pose.geometry.quaternions import orientation_error_deg, position_error_m, quat_rotate
from lightning_pose.geometry.relative import RelativeFrame, relative_poses
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.scene import Frame, Intrinsics, Scene
from lightning_pose.scenes.synthetic import render_room

FOCAL_PX = 525.0
Vector = tuple[float, float, float]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Three sequences of six frames, 4 cm and 1 or 2 degrees apart."""
    return load_scene(render_room(tmp_path_factory.mktemp("rooms") / "room", seed=3, frames=18, size=(320, 240)))


@pytest.fixture(scope="module")
def blank(tmp_path_factory: pytest.TempPathFactory) -> list[Frame]:
    """Four gray images of a camera that moves."""
    file = tmp_path_factory.mktemp("images") / "gray.png"
    cv2.imwrite(str(file), np.full((48, 64), 128, np.uint8))
    return [Frame(file, np.array([i, 0.0, 0.0]), np.array([1.0, 0, 0, 0]), "one", i) for i in range(4)]


def views(
    position: tuple[float, float, float], turn_deg: tuple[float, float, float], n: int = 300
) -> tuple[View, View]:
    """What two cameras see of n points, 0.3 pixels of noise: the first at the origin, the second at a pose."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -1.5, 2], [2, 1.5, 6], (n, 3))
    descriptors = rng.normal(size=(n, 128))
    descriptors = (descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)).astype(np.float32)
    seen = []
    for camera in (points, (points - position) @ Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()):
        assert camera[:, 2].min() > 0
        pixels = camera[:, :2] / camera[:, 2:] + rng.normal(0, 0.3 / FOCAL_PX, (n, 2))
        order = rng.permutation(n)
        seen.append(View(pixels[order], descriptors[order], FOCAL_PX))
    return seen[0], seen[1]


@pytest.mark.parametrize("turn_deg", [(0.0, 0.0, 0.0), (3.0, -5.0, 8.0), (0.0, 20.0, 0.0)])
@pytest.mark.parametrize("position", [(0.3, 0.0, 0.0), (-0.1, 0.2, 0.1), (0.0, 0.0, 0.3), (0.0, 0.0, -0.3)])
def test_the_motion_is_the_pose_of_the_second_camera_seen_from_the_first(position: Vector, turn_deg: Vector) -> None:
    motion = match_motion(*views(position, turn_deg))
    assert motion is not None
    direction = torch.nn.functional.normalize(torch.tensor(position).double(), dim=0)
    quat = Rotation.from_euler("xyz", turn_deg, degrees=True).as_quat(scalar_first=True)
    assert position_error_m(motion[0], direction) < 0.05
    assert motion[0].norm() == pytest.approx(1)
    assert orientation_error_deg(motion[1], torch.from_numpy(quat)) < 0.15


def test_slow_motion_is_not_half_a_turn_wrong() -> None:
    """Points 1000 steps away: as in a video, where OpenCV's recoverPose counts none of them."""
    for x in (0.004, -0.004):
        motion = match_motion(*views((x, 0.0, 0.0), (0.2, 0.3, 0.1)))
        assert motion is not None
        quat = Rotation.from_euler("xyz", (0.2, 0.3, 0.1), degrees=True).as_quat(scalar_first=True)
        assert orientation_error_deg(motion[1], torch.from_numpy(quat)) < 0.15


def test_a_turn_on_the_spot_is_seen() -> None:
    motion = match_motion(*views((0.0, 0.0, 0.0), (2.0, -6.0, 1.0)))
    assert motion is not None
    quat = Rotation.from_euler("xyz", (2.0, -6.0, 1.0), degrees=True).as_quat(scalar_first=True)
    assert orientation_error_deg(motion[1], torch.from_numpy(quat)) < 0.15


def test_no_motion_is_found_where_too_little_matches() -> None:
    a, b = views((0.3, 0.0, 0.0), (0.0, 0.0, 0.0))
    rng = np.random.default_rng(1)
    assert match_motion(*views((0.3, 0.0, 0.0), (0.0, 0.0, 0.0), n=11)) is None
    assert match_motion(View(a.points[:0], a.descriptors[:0], FOCAL_PX), b) is None
    strangers = rng.normal(size=b.descriptors.shape)
    strangers /= np.linalg.norm(strangers, axis=1, keepdims=True)
    assert match_motion(a, View(b.points, strangers.astype(np.float32), FOCAL_PX)) is None
    assert match_motion(View(a.points[:20], a.descriptors[:20], FOCAL_PX), _scattered(a, 20)) is None


def _scattered(view: View, n: int) -> View:
    """The first n features, each somewhere else: they match, but no camera moves so."""
    points = np.random.default_rng(2).uniform(-0.5, 0.5, (n, 2))
    return View(points, view.descriptors[:n], view.focal_px)


@pytest.mark.parametrize("relative_frame", ["camera", "world"])
def test_a_room_is_followed(room: Scene, relative_frame: RelativeFrame) -> None:
    """Six frames, 20 cm from end to end."""
    clips = np.arange(18).reshape(3, 6)
    motion = run_visual_odometry(room.frames, clips, relative_frame, progress=False)
    position_m, quat_wxyz = relative_poses(*read_clip_poses(room.frames, clips), relative_frame)
    assert (motion.steps, motion.failed_steps) == (15, 0)
    assert motion.position_m.shape == (3, 6, 3)
    assert motion.quat_wxyz.dtype == torch.float64
    assert position_error_m(motion.position_m, position_m).max() < 0.25 * position_m.norm(dim=-1).max()
    assert orientation_error_deg(motion.quat_wxyz, quat_wxyz).mean() < 1
    assert not motion.position_m[:, 0].any()


def test_world_axes_are_the_cameras_turned_by_the_true_orientation(room: Scene) -> None:
    clips = np.array([[0, 1, 2]])
    camera, world = (run_visual_odometry(room.frames, clips, axes, progress=False) for axes in ("camera", "world"))
    turn = torch.from_numpy(room.frames[0].quat_wxyz)
    torch.testing.assert_close(world.position_m, quat_rotate(turn, camera.position_m))
    torch.testing.assert_close(world.quat_wxyz, camera.quat_wxyz)
    assert (world.position_m - camera.position_m).norm() > 0.01


def test_steps_have_the_true_length_and_do_not_depend_on_the_threads(room: Scene) -> None:
    clips = torch.tensor([[0, 1], [1, 3], [4, 2]])
    motion = run_visual_odometry(room.frames, clips, progress=False, workers=1)
    lengths = [np.linalg.norm(room.frames[b].position_m - room.frames[a].position_m) for a, b in clips.tolist()]
    assert motion.position_m[:, 1].norm(dim=-1).tolist() == pytest.approx(lengths)
    again = run_visual_odometry(room.frames, clips, progress=False, workers=3)
    assert torch.equal(again.position_m, motion.position_m)
    assert torch.equal(again.quat_wxyz, motion.quat_wxyz)


def test_overlapping_clips_share_images_and_steps(room: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    described, matched, lock = [], [], threading.Lock()

    def view(frame: Frame) -> Frame:
        with lock:
            described.append(frame.index)
        return frame

    def motion(a: Frame, b: Frame) -> None:
        with lock:
            matched.append((a.index, b.index))

    monkeypatch.setattr(module, "CHUNK", 1)
    monkeypatch.setattr(module, "describe_frame", view)
    monkeypatch.setattr(module, "match_motion", motion)
    clips = np.lib.stride_tricks.sliding_window_view(np.arange(6), 4)
    found = run_visual_odometry(room.frames, clips, progress=False, workers=2)
    assert sorted(described) == list(range(6))
    assert sorted(matched) == [(i, i + 1) for i in range(5)]
    assert (found.steps, found.failed_steps) == (5, 5)


def test_steps_through_blank_images_stand_still_and_are_counted(blank: list[Frame]) -> None:
    motion = run_visual_odometry(blank, np.array([[0, 1, 2], [1, 2, 3]]), progress=False)
    assert (motion.steps, motion.failed_steps) == (3, 3)
    assert not motion.position_m.any()
    torch.testing.assert_close(motion.quat_wxyz, torch.eye(4)[0].double().expand(2, 3, 4))


def test_a_failed_step_keeps_the_others(room: Scene, blank: list[Frame]) -> None:
    frames = [*room.frames[:3], blank[0]]
    motion = run_visual_odometry(frames, np.array([[0, 1, 3, 3]]), progress=False)
    assert (motion.steps, motion.failed_steps) == (3, 1)  # a frame repeated has not moved: no failure
    first = run_visual_odometry(frames, np.array([[0, 1]]), progress=False)
    torch.testing.assert_close(motion.position_m[0, 1:], first.position_m[0, 1:].expand(3, 3))


def test_clips_of_one_frame_and_no_clips_have_no_steps(blank: list[Frame]) -> None:
    for shape in ((2, 1), (0, 5)):
        motion = run_visual_odometry(blank, np.zeros(shape, int))
        assert motion.position_m.shape == (*shape, 3)
        assert motion.quat_wxyz.shape == (*shape, 4)
        assert motion.steps == 0


def test_an_unknown_camera_is_taken_for_a_kinects() -> None:
    assert assume_intrinsics(640, 480) == Intrinsics(525, 525, 320, 240)
    assert assume_intrinsics(480, 640) == Intrinsics(525, 525, 240, 320)


def test_the_bar_is_on_stderr_and_only_if_wanted(blank: list[Frame], capfd: pytest.CaptureFixture[str]) -> None:
    run_visual_odometry(blank, np.array([[0, 1]]), progress=False)
    assert capfd.readouterr() == ("", "")
    run_visual_odometry(blank, np.array([[0, 1]]))
    out, err = capfd.readouterr()
    assert not out
    assert "visual odometry" in err
    assert "1/1" in err


def test_a_missing_image_is_named(blank: list[Frame], tmp_path: Path) -> None:
    gone = Frame(tmp_path / "gone.png", np.zeros(3), np.array([1.0, 0, 0, 0]), "one", 4)
    with pytest.raises(ImageError, match=r"gone.png does not exist"):
        run_visual_odometry([*blank, gone], np.array([[3, 4]]), progress=False)


def test_clips_that_are_no_indices_are_refused(blank: list[Frame]) -> None:
    with pytest.raises(ConfigError, match=r"clips are int64 of shape \(3,\); give \(B, T\) whole numbers"):
        run_visual_odometry(blank, np.arange(3))
    with pytest.raises(ConfigError, match=r"clips are float64 of shape \(1, 2\)"):
        run_visual_odometry(blank, np.zeros((1, 2)))
    with pytest.raises(ConfigError, match="clips name frames -1 to 4; there are 4, numbered from 0"):
        run_visual_odometry(blank, np.array([[-1, 4]]))
    with pytest.raises(ConfigError, match="relative_frame is 'body'"):
        run_visual_odometry(blank, np.array([[0, 1]]), "body")  # type: ignore[arg-type]
