"""What `inspect` finds in scenes of five frames, against values computed by hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lightning_pose.scenes.inspect import (
    count_sequence_frames,
    describe_scene,
    inspect_images,
    inspect_poses,
    read_image_files,
)
from lightning_pose.scenes.scene import Frame, Intrinsics, Scene
from tests.data.helpers import make_turned_jpeg


def turn_z(degrees: float) -> np.ndarray:
    """The quaternion wxyz of a rotation about z."""
    half = math.radians(degrees) / 2
    return np.array([math.cos(half), 0, 0, math.sin(half)])


def make_scene(
    root: Path, x_m: Sequence[float] = (0, 1, 2, 3, 4), angles_deg: Sequence[float] = (0, 10, 20, 30, 40)
) -> Scene:
    """Five frames along x, each turned about z: three of sequence `a` (two train, one validates), two of `b` (test)."""
    frames = [
        Frame(root / f"{i}.png", np.array([x, 0.0, 1.0]), turn_z(angle), "aaabb"[i], (0, 1, 2, 7, 9)[i])
        for i, (x, angle) in enumerate(zip(x_m, angles_deg, strict=True))
    ]
    splits = {"train": np.array([0, 1]), "val": np.array([2]), "test": np.array([3, 4])}
    return Scene("line", root, "tum", tuple(frames), splits, split_source="blocks")


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """`make_scene` with five different images of 8 x 6 pixels."""
    scene = make_scene(tmp_path)
    for i, frame in enumerate(scene.frames):
        image = np.full((6, 8, 3), 40 * i, np.uint8)
        image[0, 0] = 255
        cv2.imwrite(str(frame.image), image)
    return scene


def test_facts_by_hand(scene: Scene) -> None:
    assert describe_scene(scene, list(read_image_files(scene))) == {
        "format": "tum, ground truth original",
        "split (blocks)": "train 2, val 1, test 2",
        "image size": "8x6",
        "image depth": "8 bits",
        "intrinsics": "unknown",
        "extent": "4.00 x 0.00 x 0.00 m",
        # Steps of 1 m and 10 deg in `a`, and of half as much a frame in `b`, whose two frames are numbered 7 and 9.
        "frame spacing": "median 1 m, 10 deg",
        "rotation": "up to 20 deg from the mean, median 10 deg",
        "test to nearest training pose": "median 2.5 m, 25 deg; up to 3 m",
    }


def test_the_camera_and_the_unit_are_named(scene: Scene) -> None:
    frames = [replace(frame, intrinsics=Intrinsics(525.0, 525.5, 320.0, 240.0)) for frame in scene.frames]
    facts = describe_scene(replace(scene, frames=tuple(frames), unit="scene"), list(read_image_files(scene)))
    assert facts["intrinsics"] == "f 525 525.5, c 320 240"
    assert facts["extent"] == "4.00 x 0.00 x 0.00 scene"


def test_a_scene_without_steps_or_test_frames_has_fewer_facts(scene: Scene) -> None:
    one = replace(scene, frames=scene.frames[:1], splits={"train": np.array([0]), "val": [], "test": []})
    facts = describe_scene(one, list(read_image_files(one)))
    assert not {"frame spacing", "test to nearest training pose"} & facts.keys()
    assert inspect_poses(one).errors == []


def test_frames_of_each_sequence_in_each_split(scene: Scene) -> None:
    a, b = count_sequence_frames(scene)
    assert a == ("a", {"train": 2, "val": 1, "test": 0}, 0, 2)
    assert b == ("b", {"train": 0, "val": 0, "test": 2}, 7, 9)


def test_sound_images_and_poses_give_no_findings(scene: Scene) -> None:
    for findings in (inspect_images(scene, list(read_image_files(scene))), inspect_poses(scene)):
        assert (findings.errors, findings.warnings) == ([], [])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda path: path.unlink(), "does not exist"),
        (lambda path: path.write_bytes(b""), "is empty"),
        (lambda path: path.write_bytes(path.read_bytes()[:40]), "is truncated"),
    ],
    ids=["missing", "empty", "truncated"],
)
def test_bad_images_are_errors(spoil: Callable[[Path], None], message: str, scene: Scene) -> None:
    spoil(scene.frames[3].image)
    files = list(read_image_files(scene))
    assert [bool(file.error) for file in files] == [False, False, False, True, False]
    (error,) = inspect_images(scene, files).errors
    assert error.startswith(f"{scene.frames[3].image} {message}")
    assert describe_scene(scene, files)["image size"] == "8x6"


def test_without_a_readable_image_there_is_no_size(scene: Scene) -> None:
    for frame in scene.frames:
        frame.image.write_bytes(b"text")
    files = list(read_image_files(scene))
    assert describe_scene(scene, files)["image size"] == "none can be read"
    assert len(inspect_images(scene, files).errors) == 5


def test_copies_are_warned_of_and_those_across_the_split_once_more(scene: Scene) -> None:
    first, second, third, fourth, _ = (frame.image for frame in scene.frames)
    second.write_bytes(first.read_bytes())
    third.write_bytes(fourth.read_bytes())
    copies, leaks = inspect_images(scene, list(read_image_files(scene))).warnings
    assert copies.startswith("2 images are copies of others")
    assert copies.endswith(f"{second} is {first}")
    assert leaks.startswith("1 test images are also training or validation images")
    assert leaks.endswith(f"{fourth} is {third}")


def test_sizes_that_differ_are_counted(scene: Scene) -> None:
    cv2.imwrite(str(scene.frames[4].image), np.eye(3, 4, dtype=np.uint8))
    (warning,) = inspect_images(scene, list(read_image_files(scene))).warnings
    assert warning.startswith("images of 2 sizes, 8x6 (4), 4x3 (1); resize them")


def test_a_step_of_twenty_medians_is_a_jump(tmp_path: Path) -> None:
    (warning,) = inspect_poses(make_scene(tmp_path, x_m=(0, 1, 2, 3, 99))).warnings
    assert warning == f"{tmp_path / '3.png'} to 4.png: the pose jumps by 48 m and 5 deg; check both poses"
    assert inspect_poses(make_scene(tmp_path, x_m=(0, 1, 2, 3, 40))).warnings == []  # 18.5 m a frame


def test_a_turn_of_twenty_medians_is_a_jump_from_30_degrees_on(tmp_path: Path) -> None:
    for last, count in ((26, 0), (38, 1)):  # degrees of one step; the other two have 1 and 0.5
        scene = make_scene(tmp_path, angles_deg=(0, 1, 1 + last, 2, 3))
        assert len(inspect_poses(scene).warnings) == count


def test_a_camera_that_never_moves_is_an_error(tmp_path: Path) -> None:
    (error,) = inspect_poses(make_scene(tmp_path, x_m=(2,) * 5)).errors
    assert error.startswith("all 5 positions are [2. 0. 1.]; there is nothing to learn")


@pytest.mark.parametrize(("blank", "errors"), [(2, 0), (3, 1)])
def test_blank_images_are_counted_and_refused_where_most_are(blank: int, errors: int, scene: Scene) -> None:
    for i in range(blank):
        cv2.imwrite(str(scene.frames[i].image), np.full((6, 8), 90 + i, np.uint8))
    findings = inspect_images(scene, list(read_image_files(scene)))
    assert len(findings.errors) == errors
    text = f"{blank} images have one value in all pixels, such as {scene.frames[0].image}"
    assert any(text in line for line in (findings.errors if errors else findings.warnings))


def test_mixed_depths_are_warned_of(scene: Scene) -> None:
    cv2.imwrite(str(scene.frames[2].image), np.array([[0, 4000]], np.uint16).repeat(4, 1).repeat(6, 0))
    files = list(read_image_files(scene))
    assert describe_scene(scene, files)["image depth"] == "8 bits (4), 12 bits (1)"
    (warning,) = inspect_images(scene, files).warnings
    assert warning.startswith("images of 2 depths, 8 bits (4), 12 bits (1)")


def test_exif_orientation_is_warned_of(scene: Scene) -> None:
    for i in (1, 3):
        scene.frames[i].image.write_bytes(make_turned_jpeg(np.eye(6, 8, dtype=np.uint8) * (100 + i), 6))
    (warning,) = inspect_images(scene, list(read_image_files(scene))).warnings
    assert f"2 of 5 images have an EXIF orientation (orientation 6), such as {scene.frames[1].image}" in warning
    assert "refer to the pixels as stored" in warning


@pytest.mark.parametrize(("x_m", "count"), [((1, 0, 0, 0, 2), 2), ((0, 0, 1, 0, 2), 0), ((0, 0, 0, 1, 2), 0)])
def test_poses_at_the_origin_are_counted(x_m: Sequence[float], count: int, tmp_path: Path) -> None:
    """The third case has them at the start of the sequence, where they are right. Frame 3 begins a sequence."""
    scene = make_scene(tmp_path, x_m, [0] * 5)
    frames = [replace(frame, position_m=frame.position_m * [1, 1, 0]) for frame in scene.frames]
    warnings = inspect_poses(replace(scene, frames=tuple(frames))).warnings
    found = [text for text in warnings if "exactly at the origin" in text]
    assert [text.split()[0] for text in found] == ([str(count)] if count else [])
