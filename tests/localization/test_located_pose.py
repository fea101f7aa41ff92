"""LocatedPose: what it derives, what goes into JSON, and the covariance that a map gives."""

from __future__ import annotations

import doctest
import json
import math
import threading

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from lightning_pose.localization import exif, localizer, located_pose
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import LocatedPose, refuse_image
from lightning_pose.localization.trained_system import TrainedSystem
from lightning_pose.scenes import cameras
from tests.rooms import MappedRoom


@pytest.fixture(scope="module")
def room_localizer(mapped_room: MappedRoom) -> Localizer:
    return Localizer.load(mapped_room.checkpoint)


def test_the_matrix_is_that_of_the_quaternion() -> None:
    quat = np.random.default_rng(0).normal(size=4)
    quat /= np.linalg.norm(quat)
    matrix = LocatedPose(np.arange(3.0), quat).T_world_cam
    np.testing.assert_allclose(matrix[:3, :3], Rotation.from_quat(quat, scalar_first=True).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(matrix[:, 3], [0, 1, 2, 1])


@pytest.mark.parametrize("module", [located_pose, exif, cameras, localizer], ids=lambda module: module.__name__)
def test_docstring_examples(module: object, mapped_room: MappedRoom) -> None:
    names = {"checkpoint": mapped_room.checkpoint, "image": mapped_room.images[0]}
    assert doctest.testmod(module, extraglobs=names, optionflags=doctest.NORMALIZE_WHITESPACE)[0] == 0  # type: ignore[arg-type]


def test_an_answer_is_plain_json(room_localizer: Localizer, mapped_room: MappedRoom) -> None:
    for pose in (room_localizer.localize(mapped_room.images[0]), refuse_image("a.jpg", "is empty")):
        plain = json.loads(json.dumps(pose.to_dict(), allow_nan=False))
        assert plain["status"] == pose.status
        assert plain["radius_m"] == (pose.radius_m if math.isfinite(pose.radius_m) else None)
        assert len(plain["T_world_cam"]) == 4


def test_the_covariance_is_in_the_world_s_axes(room_localizer: Localizer, mapped_room: MappedRoom) -> None:
    """Answers for noisy images spread as the covariance says, within a factor, in every axis of the world."""
    rng, image = np.random.default_rng(0), mapped_room.read(7).astype(np.float64)
    noisy = [np.clip(image + rng.normal(0, 8, image.shape), 0, 255).astype(np.uint8) for _ in range(25)]
    poses = room_localizer.localize(noisy)
    first = poses[0]
    turns = [
        (Rotation.from_quat(pose.quat_wxyz, scalar_first=True)
         * Rotation.from_quat(first.quat_wxyz, scalar_first=True).inv()).as_rotvec()
        for pose in poses
    ]  # fmt: skip
    spread = np.cov(np.column_stack([[pose.position_m for pose in poses], turns]).T)
    assert first.covariance is not None
    np.testing.assert_allclose(first.covariance, first.covariance.T, atol=1e-12)
    said = np.mean([pose.covariance for pose in poses if pose.covariance is not None], axis=0)
    # Position and rotation are strongly correlated, with signs that depend on the axes.
    cross = [block / np.sqrt(np.outer(np.diag(matrix)[:3], np.diag(matrix)[3:]))
             for matrix in (spread, said) for block in (matrix[:3, 3:],)]  # fmt: skip
    strong = np.abs(cross[1]) > 0.6
    assert strong.any()
    assert (np.sign(cross[0][strong]) == np.sign(cross[1][strong])).all()
    # A normal distribution of that covariance has 90 % of positions within the radius, if axes are alike.
    assert first.radius_m == pytest.approx(1.4435 * math.sqrt(np.trace(first.covariance[:3, :3])), rel=1e-3)
    assert math.radians(first.radius_deg) == pytest.approx(
        1.4435 * math.sqrt(np.trace(first.covariance[3:, 3:])), rel=1e-3
    )


def test_threads_get_the_same_answers(mapped_room: MappedRoom) -> None:
    localizer = Localizer.load(mapped_room.checkpoint)  # fresh: the first query prepares the map
    assert isinstance(localizer.system, TrainedSystem)
    before = {
        name: value.clone() for name, value in localizer.system.model.state_dict().items() if torch.is_tensor(value)
    }
    found: dict[int, list[LocatedPose]] = {}

    def work(worker: int) -> None:
        found[worker] = localizer.localize(mapped_room.images[:6])

    threads = [threading.Thread(target=work, args=(worker,)) for worker in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    alone = localizer.localize(mapped_room.images[:6])
    for poses in found.values():
        for pose, expected in zip(poses, alone, strict=True):
            np.testing.assert_array_equal(pose.position_m, expected.position_m)
            np.testing.assert_array_equal(pose.quat_wxyz, expected.quat_wxyz)
    for name, value in localizer.system.model.state_dict().items():
        assert not torch.is_tensor(value) or torch.equal(value, before[name]), name
