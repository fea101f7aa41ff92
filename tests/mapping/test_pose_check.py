"""`check` proves the convention of the poses of a rendered room, whatever its files hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lightning_pose.mapping.conventions import AS_READ
from lightning_pose.mapping.pose_check import check_poses
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.scene import Frame, Intrinsics, Scene, Trajectory
from lightning_pose.scenes.synthetic import render_room


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(render_room(tmp_path_factory.mktemp("rooms") / "room", frames=40, size=(160, 120)))


def rewrite(scene: Scene, change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Scene:
    """The scene as a reader that expects camera-to-world OpenCV poses gets it from files of another convention."""

    def change_frame(frame: Frame) -> Frame:
        rotation, position_m = change(
            Rotation.from_quat(frame.quat_wxyz, scalar_first=True).as_matrix(), frame.position_m
        )
        quat_wxyz = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
        return replace(frame, position_m=position_m, quat_wxyz=quat_wxyz)

    return replace(scene, frames=tuple(map(change_frame, scene.frames)))


def test_right_poses_fit_and_the_focal_length_is_found(room: Scene) -> None:
    found = check_poses(room)
    assert (found.errors, found.warnings) == ([], [])
    assert found.readings[0].name == AS_READ
    assert found.readings[0].residual_px < 0.3
    assert found.focal_px == pytest.approx(525 / 4, rel=0.05)
    assert set(found.facts) == {"features per frame", "poses and images", "focal length", "distance of what is seen"}


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("world-to-camera", lambda R, c: (R.T, -R.T @ c)),
        ("OpenGL axes (y up, z backward)", lambda R, c: (R @ np.diag([1.0, -1, -1]), c)),
        ("camera centre with a world-to-camera rotation", lambda R, c: (R.T, c)),
    ],
)
def test_another_convention_is_an_error_that_names_it(
    room: Scene, name: str, change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
) -> None:
    (error,) = check_poses(rewrite(room, change)).errors
    assert f"if the files hold: {name} (0." in error
    assert "convert the pose files" in error


def test_another_order_of_world_to_camera_quaternions_is_named(room: Scene) -> None:
    def misread(rotation: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        filed = Rotation.from_matrix(rotation.T).as_quat()  # x, y, z, w, read as w, x, y, z
        return Rotation.from_quat(filed, scalar_first=True).as_matrix().T, position

    (error,) = check_poses(replace(rewrite(room, misread), format="cambridge")).errors
    assert "if the files hold: quaternion order xyzw (0." in error


def test_millimetres_are_a_warning(room: Scene) -> None:
    found = check_poses(rewrite(room, lambda R, c: (R, 1000 * c)))
    (warning,) = found.warnings
    assert "implausible; if the positions are in millimetres" in warning
    assert found.errors == []


def test_a_wrong_focal_length_is_a_warning(room: Scene) -> None:
    wrong = Intrinsics(250.0, 250.0, 79.5, 59.5)
    (warning,) = check_poses(replace(room, frames=tuple(replace(f, intrinsics=wrong) for f in room.frames))).warnings
    assert "the dataset's focal length is 250 px, and 13" in warning


def test_poses_of_other_images_fit_under_no_convention(room: Scene) -> None:
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(len(room.frames))
    frames = tuple(replace(f, image=room.frames[k].image) for f, k in zip(room.frames, shuffled, strict=True))
    found = check_poses(replace(room, frames=frames))
    assert not found.errors
    assert any("do not fit the images under any usual convention" in warning for warning in found.warnings)


def test_a_camera_that_stands_still_is_not_compared(room: Scene) -> None:
    found = check_poses(rewrite(room, lambda R, c: (R, np.zeros(3))))
    assert found.facts["poses and images"].startswith("not compared")
    assert (found.errors, found.warnings, found.readings) == ([], [], [])


@pytest.mark.parametrize("offset_s", [0.0, 0.05])
def test_clocks_that_differ_are_a_warning(room: Scene, offset_s: float) -> None:
    frames = tuple(replace(f, sequence="walk", timestamp=0.1 * i) for i, f in enumerate(room.frames))
    positions, quats = (np.array([getattr(f, name) for f in frames]) for name in ("position_m", "quat_wxyz"))
    times = np.array([0.1 * i for i in range(len(frames))])
    found = check_poses(replace(room, frames=frames, trajectory=Trajectory(times + offset_s, positions, quats)))
    assert "clock of the poses" in found.facts
    shifted = [
        warning for warning in found.warnings if "subtract 0.0" in warning and "the times of the poses" in warning
    ]
    assert len(shifted) == (offset_s > 0)
    assert found.errors == []


def test_images_with_few_features_are_counted(room: Scene, tmp_path: Path) -> None:
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((120, 160), 90, np.uint8))
    frames = (replace(room.frames[0], image=blank), *room.frames[1:])
    (warning,) = check_poses(replace(room, frames=frames)).warnings
    assert warning.startswith("1 of ")
    assert "fewer than 25 features" in warning


def test_images_that_cannot_be_read_are_passed_over(room: Scene) -> None:
    gone = tuple(replace(f, image=Path("gone.png")) for f in room.frames)
    assert "features per frame" not in check_poses(replace(room, frames=gone)).facts


def test_a_camera_of_resized_images_is_scaled() -> None:
    camera = Intrinsics(525.0, 525.0, 319.5, 239.5, size=(640, 480))
    assert camera.for_size(320, 240) == Intrinsics(262.5, 262.5, 159.5, 119.5, size=(320, 240))
    assert camera.for_size(640, 480) is camera
