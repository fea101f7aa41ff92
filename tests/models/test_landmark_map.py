"""LandmarkMap as an architecture: cameras, refusals, checkpoints, and what a test says of it."""

from __future__ import annotations

import os
from copy import deepcopy
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import torch
from lightning import Trainer

from lightning_pose.checkpoint import build_object
from lightning_pose.errors import ConfigError, DataError
from lightning_pose.evaluation.maps import evaluate_map
from lightning_pose.features import SURF
from lightning_pose.geometry.camera import Camera
from lightning_pose.geometry.quaternions import position_error_m
from lightning_pose.metrics import catalog
from lightning_pose.models import LandmarkMap
from tests.models.helpers import WALL_CAMERA, WALL_KEYPOINTS, WallProblem


def fit_wall(
    problem: WallProblem | None = None, strategy: str = "auto", **settings: object
) -> tuple[LandmarkMap, WallProblem]:
    problem = problem or WallProblem([WALL_KEYPOINTS, 36])
    model = LandmarkMap(**{"input_shape": [WALL_KEYPOINTS, 36], "bundle_adjust": False, **settings})  # type: ignore[arg-type]
    trainer = Trainer(
        max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, strategy=strategy,
    )  # fmt: skip
    trainer.fit(model, datamodule=problem)
    return model.eval(), problem


@pytest.fixture(scope="module")
def fitted() -> tuple[LandmarkMap, WallProblem]:
    return fit_wall()


def test_test_frames_are_located_to_a_centimetre(fitted: tuple[LandmarkMap, WallProblem]) -> None:
    model, problem = fitted
    data = problem.dataset("test").data
    assert position_error_m(model(data.features).position_m, data.position_m).median() < 0.01


def test_processes_that_share_the_training_build_the_same_map(fitted: tuple[LandmarkMap, WallProblem]) -> None:
    """One process, in a group of one, as each of several is."""
    with mock.patch.dict(os.environ):  # Lightning leaves its rank there, and a later command would wait for others
        try:
            model, _ = fit_wall(strategy="ddp")
        finally:
            torch.distributed.destroy_process_group()
    for name, value in fitted[0].state_dict().items():
        assert torch.equal(model.state_dict()[name], value), name


def test_without_a_camera_the_focal_length_is_found_and_printed(capsys: pytest.CaptureFixture[str]) -> None:
    model, problem = fit_wall(WallProblem([WALL_KEYPOINTS, 36], cameras=[None]))
    printed = capsys.readouterr().out
    assert "the camera is unknown: a focal length of" in printed
    assert "map of 24 frames" in printed
    assert model.network.view.focal_px == pytest.approx(500, rel=0.03)
    data = problem.dataset("test").data
    assert position_error_m(model(data.features).position_m, data.position_m).median() < 0.03


def test_without_a_map_and_a_camera_frames_are_refused() -> None:
    """As validation does that comes before training."""
    problem = WallProblem([WALL_KEYPOINTS, 36], cameras=[None])
    model = LandmarkMap(input_shape=[WALL_KEYPOINTS, 36])
    model.trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    position, _ = model.decode_batch(problem.dataset("test").data)
    assert position.isfinite().all()


def test_each_frame_has_its_own_camera(capsys: pytest.CaptureFixture[str]) -> None:
    """Two cameras with distortion, of images that differ in size; one of them is a fisheye."""
    cameras = [
        "OPENCV,1280,960,1000,1010,650,470,-0.2,0.05,0.001,-0.002",
        "OPENCV_FISHEYE,320,240,220,225,150,125,0.05,0,0,0",
    ]
    model, problem = fit_wall(WallProblem([WALL_KEYPOINTS, 36], count=20, cameras=cameras))
    assert "2 cameras; images that come without one are located as if by" in capsys.readouterr().out
    data = problem.dataset("test").data
    error = position_error_m(model.predict_step(data, 0).position_m, data.position_m)
    assert error[::2].median() < 0.01
    assert error[1::2].median() < 0.01
    without = position_error_m(model(data.features).position_m, data.position_m)
    assert without[1::2].median() > 0.02


def test_images_of_another_size_are_located_as_well(fitted: tuple[LandmarkMap, WallProblem]) -> None:
    model, _ = fitted
    errors = []
    for width, height in ((640, 480), (320, 240), (1280, 960)):
        seen_by = str(Camera.parse(WALL_CAMERA).resize(width, height))
        data = WallProblem([WALL_KEYPOINTS, 36], count=30, cameras=[seen_by]).dataset("test").data
        pose = model.locate_images(data.features, [(width, height)] * 30)
        errors.append(position_error_m(torch.from_numpy(pose.position_m), data.position_m).median())
    assert max(errors) < 1.05 * errors[0]


def test_images_of_another_camera_need_it(fitted: tuple[LandmarkMap, WallProblem]) -> None:
    model, _ = fitted
    other = "SIMPLE_RADIAL,640,640,380,300,330,-0.1"
    data = WallProblem([WALL_KEYPOINTS, 36], count=30, cameras=[other]).dataset("test").data
    pose = model.locate_images(data.features, [(640, 640)] * 30, Camera.parse(other))
    assert position_error_m(torch.from_numpy(pose.position_m), data.position_m).median() < 0.01
    with pytest.raises(ConfigError, match=r"640x640 pixels, and its camera is for 640x480.*give camera for its own"):
        model.locate_images(data.features, [(640, 640)] * 30)


def test_a_checkpoint_holds_the_map(fitted: tuple[LandmarkMap, WallProblem]) -> None:
    model, problem = fitted
    rebuilt: LandmarkMap = build_object(model.describe())
    rebuilt.load_state_dict(model.state_dict())
    features = problem.dataset("test").data.features[:3]
    torch.testing.assert_close(rebuilt.eval()(features), model(features), rtol=0, atol=0)
    assert sum(value.nbytes for value in model.state_dict().values()) < 300_000


def test_a_checkpoint_holds_arrays_in_half_their_bytes_if_that_loses_nothing(
    fitted: tuple[LandmarkMap, WallProblem],
) -> None:
    model, _ = fitted
    network, state = model.network, model.state_dict()
    assert state["network.seen_point"].dtype == torch.uint16
    assert state["network.points"].dtype == torch.float32
    rebuilt: LandmarkMap = build_object(model.describe())
    rebuilt.load_state_dict(state)
    for name, value in vars(network.point_map).items():
        np.testing.assert_array_equal(getattr(rebuilt.network.point_map, name), value)
    network = deepcopy(network)
    network.get_buffer("seen_point").data[-1] = 70_000
    network.get_buffer("points").data[0, 0] = 1 + 2**-40
    state = network.state_dict()
    assert (state["seen_point"].dtype, int(state["seen_point"][-1])) == (torch.int32, 70_000)
    assert (state["points"].dtype, float(state["points"][0, 0])) == (torch.float64, 1 + 2**-40)


def test_answers_are_accepted_with_a_radius_or_refused_with_a_reason(fitted: tuple[LandmarkMap, WallProblem]) -> None:
    model, problem = fitted
    features = problem.dataset("test").data.features[:2].clone()
    features[1] = 0
    answers = model.network.locate(features)
    radius_m, radius_deg = model.network.find_radii(answers)
    assert [answer.accepted for answer in answers] == [True, False]
    assert answers[1].reason == "too few features: 0"
    assert 0 < radius_m[0] < 0.1
    assert 0 < radius_deg[0] < 1
    assert radius_m[1] == np.inf


def test_a_test_says_what_the_map_accepts_and_how_well_it_knows(fitted: tuple[LandmarkMap, WallProblem]) -> None:
    model, problem = fitted
    data = problem.dataset("test").data
    answers = model.network.locate(data.features)
    found = evaluate_map(
        model.network, answers, model.world_frame, model(data.features), problem.scene, data, "LandmarkMap"
    )
    assert found.metrics.keys() == {f"test/{name}" for name in catalog.MAP}
    assert found.metrics["test/accepted"] == 1.0
    assert found.metrics["test/coverage_position"] > 0.6
    assert found.figures.keys() == {"map", "error_vs_inliers", "calibration"}
    assert list(found.rows) == ["of these 100% accepted"]


def test_features_without_places_are_refused() -> None:
    problem = WallProblem([WALL_KEYPOINTS, 36])
    problem.extractor = SURF(WALL_KEYPOINTS)
    with pytest.raises(ConfigError, match=r"needs keypoints with their places.*with_geometry: true"):
        fit_wall(problem)


def test_frames_of_which_nothing_can_be_triangulated_are_refused() -> None:
    problem = WallProblem([WALL_KEYPOINTS, 36])
    frames = problem.scene.frames
    problem._scene = replace(problem.scene, frames=tuple(replace(f, position_m=np.zeros(3)) for f in frames))
    with pytest.raises(DataError, match=r"no point of wall could be triangulated from 12 frames.*check"):
        fit_wall(problem)


def test_bundle_adjustment_that_is_not_understood_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"bundle_adjust is 'yes'; give true, false or auto"):
        LandmarkMap(input_shape=[50, 68], bundle_adjust="yes")  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def map_checkpoint(fitted: tuple[LandmarkMap, WallProblem], tmp_path_factory: pytest.TempPathFactory) -> str:
    """The checkpoint of the fitted map."""
    path = tmp_path_factory.mktemp("map") / "best.ckpt"
    model, _ = fitted
    model.trainer.save_checkpoint(path)
    return str(path)


def test_a_map_is_extended_by_the_frames_of_another_recording(
    fitted: tuple[LandmarkMap, WallProblem], map_checkpoint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    known, problem = fitted
    model, _ = fit_wall(extends=map_checkpoint)
    assert "map of 24 frames and 24 more" in capsys.readouterr().out
    old, new = known.network.point_map, model.network.point_map
    assert len(new.position) == 2 * len(old.position)
    np.testing.assert_array_equal(new.points[: len(old)], old.points)
    assert len(new) < 1.1 * len(old), "what is seen again is no new point"
    data = problem.dataset("test").data
    assert position_error_m(model(data.features).position_m, data.position_m).median() < 0.01
    assert model.network.calibration.isfinite().all()


def test_a_map_of_other_features_is_not_extended(map_checkpoint: str) -> None:
    problem = WallProblem([WALL_KEYPOINTS, 36])
    problem.extractor = SURF(WALL_KEYPOINTS - 1, with_geometry=True)
    with pytest.raises(ConfigError, match=r"give data\.extractor the same"):
        fit_wall(problem, extends=map_checkpoint)
