"""Ground truths: the constant transform, files of pseudo ground truth, frames without a pose, and refusals."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.ground_truth import DEPTH_TO_COLOUR, apply_ground_truth
from lightning_pose.scenes.scene import Scene
from tests.data.helpers import REAL_DATA, write_seven_scenes

KITCHEN = REAL_DATA / "7scenes" / "redkitchen"
PGT = REAL_DATA / "7scenes" / "pgt"


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return load_scene(write_seven_scenes(tmp_path / "office", {1: 4}, {2: 3}), val_fraction=0)


def positions(scene: Scene) -> np.ndarray:
    return np.array([frame.position_m for frame in scene.frames])


def rotations(scene: Scene) -> Rotation:
    return Rotation.from_quat([frame.quat_wxyz for frame in scene.frames], scalar_first=True)


def write_pgt(folder: Path, scene: Scene, kind: str = "sfm", shift: float = 1.0, prefix: str = "") -> Path:
    """Files with the scene's poses moved along x, world-to-camera, and a focal length of 585."""
    file = folder / kind / "7scenes" / f"{scene.name}_train.txt"
    file.parent.mkdir(parents=True)
    lines = []
    for frame in scene.frames:
        cam_world = Rotation.from_quat(frame.quat_wxyz, scalar_first=True).inv()
        quat = cam_world.as_quat(scalar_first=True)
        t = -cam_world.apply(frame.position_m + np.array([shift, 0, 0]))
        name = prefix + frame.image.relative_to(scene.root).as_posix()
        lines.append(f"{name} {' '.join(f'{value:.12g}' for value in (*quat, *t))} 585")
    file.write_text("\n".join(lines[:4]) + "\n")
    file.with_name(f"{scene.name}_test.txt").write_text("\n".join(lines[4:]) + "\n")
    return folder


def test_the_original_truth_is_the_dataset_s_own(scene: Scene) -> None:
    assert apply_ground_truth(scene, "original") is scene


def test_registered_poses_are_those_of_the_colour_camera(scene: Scene) -> None:
    moved = apply_ground_truth(scene, "registered")
    assert moved.ground_truth == "registered"
    for before, after in zip(scene.frames, moved.frames, strict=True):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat(before.quat_wxyz, scalar_first=True).as_matrix()
        T[:3, 3] = before.position_m
        expected = T @ DEPTH_TO_COLOUR
        np.testing.assert_allclose(after.position_m, expected[:3, 3], atol=1e-12)
        turned = Rotation.from_quat(after.quat_wxyz, scalar_first=True).as_matrix()
        np.testing.assert_allclose(turned, expected[:3, :3], atol=1e-4)
    assert moved.splits is scene.splits


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_files_are_world_to_camera_and_have_the_focal_length(tmp_path: Path, suffix: str) -> None:
    scene = load_scene(write_seven_scenes(tmp_path / "office", {1: 4}, {2: 3}, suffix), val_fraction=0)
    pgt = write_pgt(tmp_path / "pgt", scene)
    listed = pgt / "sfm/7scenes/office_train.txt"
    listed.write_text(listed.read_text().replace(".jpg", ".png"))
    other = apply_ground_truth(scene, "sfm", str(pgt))
    assert other.ground_truth == "sfm"
    np.testing.assert_allclose(positions(other), positions(scene) + np.array([1, 0, 0]), atol=1e-9)
    np.testing.assert_allclose((rotations(other) * rotations(scene).inv()).magnitude(), 0, atol=1e-9)
    camera = other.frames[0].intrinsics
    assert camera is not None
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (585, 585, 320, 240)


def test_registered_poses_come_from_files_where_there_are_some(tmp_path: Path, scene: Scene) -> None:
    pgt = write_pgt(tmp_path / "pgt", scene, "dslam", shift=0.5)
    moved = apply_ground_truth(scene, "registered", str(pgt))
    np.testing.assert_allclose(positions(moved), positions(scene) + np.array([0.5, 0, 0]), atol=1e-9)


def test_frames_that_are_not_listed_are_dropped_and_counted(
    tmp_path: Path, scene: Scene, caplog: pytest.LogCaptureFixture
) -> None:
    pgt = write_pgt(tmp_path / "pgt", scene)
    file = pgt / "sfm/7scenes/office_train.txt"
    file.write_text("\n".join(file.read_text().splitlines()[1:]))
    with caplog.at_level(logging.WARNING):
        other = apply_ground_truth(scene, "sfm", str(pgt))
    assert "dropped 1 of 7 frames" in caplog.text
    assert [other.frames[i].image for i in other.splits["test"]] == [
        scene.frames[i].image for i in scene.splits["test"]
    ]
    assert len(other.splits["train"]) == 3


def test_scenes_of_12_scenes_are_named_with_the_folder_above(tmp_path: Path) -> None:
    """`apt1/kitchen` is `apt1_kitchen_train.txt`; its images are named without their folder."""
    scene = load_scene(write_seven_scenes(tmp_path / "apt1/kitchen", {1: 3}, {2: 1}), val_fraction=0)
    frames = tuple(
        replace(frame, image=scene.root / "data" / f"frame-{i:06d}.color.jpg") for i, frame in enumerate(scene.frames)
    )
    scene = replace(scene, name="kitchen", format="12scenes", frames=frames)
    folder = tmp_path / "pgt/sfm/12scenes"
    folder.mkdir(parents=True)
    lines = [f"frame-{i:06d}.color.jpg 1 0 0 0 {-i} 0 0 572" for i in range(4)]
    (folder / "apt1_kitchen_train.txt").write_text("\n".join(lines))
    other = apply_ground_truth(scene, "sfm", str(tmp_path / "pgt"))
    np.testing.assert_allclose(positions(other)[:, 0], range(4))


@pytest.mark.parametrize(
    ("truth", "pgt", "message"),
    [
        ("sfm", None, "data.pgt"),
        ("original", "pgt", "set sfm or registered"),
        ("other", None, "give one of original, registered, sfm"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(
    scene: Scene, truth: str, pgt: str | None, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        apply_ground_truth(scene, truth, pgt)  # type: ignore[arg-type]


def test_scenes_without_such_a_truth_are_refused(tmp_path: Path, scene: Scene) -> None:
    with pytest.raises(ConfigError, match="are synthetic; set original"):
        apply_ground_truth(replace(scene, ground_truth="synthetic"), "registered")
    with pytest.raises(ConfigError, match="only 7-Scenes has a known transform"):
        apply_ground_truth(replace(scene, format="tum"), "registered")
    with pytest.raises(DataError, match=r"office_train\.txt"):
        apply_ground_truth(scene, "sfm", str(tmp_path))


@pytest.mark.parametrize("line", ["b 1 0 0 0 0 0 0", "a 1 0 0 0 0 0 x 5", "a 1 0 0 0 0 0 0 -1", "a 2 0 0 0 0 0 0 9"])
def test_malformed_and_foreign_files_are_refused(tmp_path: Path, scene: Scene, line: str) -> None:
    file = write_pgt(tmp_path / "pgt", scene) / "sfm/7scenes/office_train.txt"
    file.write_text(line)
    with pytest.raises(DataError, match=r"office_train.txt:1: expected .image qw"):
        apply_ground_truth(scene, "sfm", str(tmp_path / "pgt"))
    file.write_text("other/place.png 1 0 0 0 0 0 0 585")
    file.with_name("office_test.txt").unlink()
    with pytest.raises(DataError, match="lists 1 images, such as other/place, but none of"):
        apply_ground_truth(scene, "sfm", str(tmp_path / "pgt"))


@pytest.mark.skipif(not KITCHEN.is_dir() or not PGT.is_dir(), reason="needs the real kitchen")
def test_the_constant_transform_agrees_with_the_registered_kitchen() -> None:
    kitchen = load_scene(KITCHEN)
    constant, files = (apply_ground_truth(kitchen, "registered", pgt) for pgt in (None, str(PGT)))
    assert np.median(np.linalg.norm(positions(constant) - positions(files), axis=1)) < 1e-3
    assert np.degrees(np.median((rotations(constant).inv() * rotations(files)).magnitude())) < 0.01
    sfm = apply_ground_truth(kitchen, "sfm", str(PGT))
    assert len(sfm.frames) == len(kitchen.frames)
    assert sfm.frames[0].intrinsics is not None
    assert sfm.frames[0].intrinsics.fx == 525.505
