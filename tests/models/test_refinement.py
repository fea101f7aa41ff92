"""A landmark map behind a regressor: whose pose a frame gets, what a checkpoint holds, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from lightning import Trainer

from lightning_pose.checkpoint import build_object
from lightning_pose.data.batches import PoseBatch, PoseDataset, make_loader
from lightning_pose.errors import CheckpointError, ConfigError
from lightning_pose.evaluation.callback import TestReport
from lightning_pose.geometry.quaternions import position_error_m
from lightning_pose.models import CNNRNN, KernelPoseNet, LandmarkMap, LinearPoseNet, PoseModule
from tests.models.helpers import RefinableProblem

BLANK = 3
"""Frames of the test split that show nothing."""


def make_trainer(folder: Path, *callbacks: TestReport) -> Trainer:
    return Trainer(
        default_root_dir=folder, max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, callbacks=list(callbacks),
    )  # fmt: skip


def make_problem() -> RefinableProblem:
    """A wall of which the map cannot locate the first test frames, because their keypoints are missing."""
    problem = RefinableProblem()
    for split, frames in problem.keypoints.items():
        if split == "test":
            features = frames.data.features.clone()
            features[:BLANK] = 0
            problem.keypoints[split] = PoseDataset(frames.data._replace(features=features))
    problem.val_dataloader = lambda: make_loader(problem.dataset("val"), 8, shuffle=False)  # type: ignore[method-assign]
    problem.test_dataloader = lambda: make_loader(problem.dataset("test"), 8, shuffle=False)  # type: ignore[method-assign]
    return problem


def fit(folder: Path, **settings: Any) -> tuple[PoseModule, RefinableProblem, Trainer]:
    problem, trainer = make_problem(), make_trainer(folder)
    model = LinearPoseNet(input_shape=[16], lambdas=[1e-3], **settings)
    trainer.fit(model, datamodule=problem)
    return model, problem, trainer


@pytest.fixture(scope="module")
def refined(tmp_path_factory: pytest.TempPathFactory) -> tuple[PoseModule, RefinableProblem, Trainer]:
    return fit(tmp_path_factory.mktemp("refined"), refine={"bundle_adjust": False})


def predict(model: PoseModule, problem: RefinableProblem, folder: Path) -> torch.Tensor:
    batches = make_trainer(folder).predict(model, dataloaders=None, datamodule=problem)
    return torch.cat([batch.position_m for batch in batches])  # type: ignore[union-attr]


def test_frames_have_the_pose_of_the_map_where_it_accepts(
    refined: tuple[PoseModule, RefinableProblem, Trainer], tmp_path: Path
) -> None:
    model, problem, _ = refined
    problem.predict_dataloader = problem.test_dataloader
    data: PoseBatch = problem.dataset("test").data
    found, alone = predict(model, problem, tmp_path), model(data.features).position_m
    torch.testing.assert_close(found[:BLANK], alone[:BLANK])
    assert position_error_m(found[BLANK:], data.position_m[BLANK:]).max() < 0.05
    assert position_error_m(alone[BLANK:], data.position_m[BLANK:]).median() > 0.05


def test_the_regressor_is_trained_as_without(
    refined: tuple[PoseModule, RefinableProblem, Trainer], tmp_path: Path
) -> None:
    alone, _, _ = fit(tmp_path)
    state = refined[0].state_dict()
    for name, value in alone.state_dict().items():  # frames come in another order, and sums are rounded
        torch.testing.assert_close(state[name], value, rtol=1e-6, atol=1e-6, msg=name)
    assert alone.refinement is None


def test_the_map_is_of_the_frames_that_the_regressor_learns_from(
    refined: tuple[PoseModule, RefinableProblem, Trainer], tmp_path: Path
) -> None:
    frames = {"train": 12, "train, val": 24}
    assert refined[0].refinement is not None
    assert len(refined[0].refinement.network.position) == frames["train, val"]
    fewer, _, _ = fit(tmp_path, refine={"bundle_adjust": False}, refit=False)
    assert fewer.refinement is not None
    assert len(fewer.refinement.network.position) == frames["train"]


def test_a_test_has_rows_alone_refined_and_accepted(
    refined: tuple[PoseModule, RefinableProblem, Trainer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, problem, _ = refined
    report = TestReport(log_model=False)
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("wall.png", np.zeros((48, 64), np.uint8))  # to time the extractors
    make_trainer(tmp_path, report).test(model, datamodule=problem, verbose=False)
    names = ["LinearPoseNet refined", "of these 75% accepted", "LinearPoseNet alone", "train_mean"]
    assert list(report.results)[:4] == names
    median = "position_median_m"
    assert report.results[names[1]][median] <= report.results[names[0]][median] < report.results[names[2]][median]
    assert report.evaluation is not None
    extras = report.evaluation.extras
    assert extras["test/accepted"] == pytest.approx(1 - BLANK / 12)
    assert extras["test/alone_position_median_m"] == report.results[names[2]][median]


def test_one_checkpoint_holds_both(refined: tuple[PoseModule, RefinableProblem, Trainer]) -> None:
    model, problem, _ = refined
    rebuilt: PoseModule = build_object(model.describe())
    rebuilt.load_state_dict(model.state_dict())
    features = problem.dataset("test").data.features
    keypoints = problem.with_extractor(rebuilt.refinement.extractor).dataset("test").data.features  # type: ignore[union-attr]
    sizes = [(640, 480)] * len(features)
    ours, theirs = (each.eval().locate_images(features, sizes, keypoints=keypoints) for each in (model, rebuilt))
    np.testing.assert_array_equal(ours.position_m, theirs.position_m)
    assert theirs.source == ("network",) * BLANK + ("map",) * (12 - BLANK)
    assert theirs.reason == ("too few features: 0",) * BLANK + ("",) * (12 - BLANK)
    assert (theirs.radius_m[BLANK:] < 0.1).all()


def test_a_checkpoint_without_a_map_is_refused_and_one_with_it_gives_the_regressor_alone(
    refined: tuple[PoseModule, RefinableProblem, Trainer],
) -> None:
    model, _, _ = refined
    alone, other = KernelPoseNet(input_shape=[16]), LinearPoseNet(input_shape=[16])
    checkpoint = {"state_dict": dict(model.state_dict())}
    other.on_load_checkpoint(checkpoint)
    other.load_state_dict(checkpoint["state_dict"])
    with pytest.raises(CheckpointError, match=r"refine is on, but the checkpoint has no map; leave it out"):
        KernelPoseNet(input_shape=[16], refine=True).on_load_checkpoint({"state_dict": dict(alone.state_dict())})


def test_what_takes_no_map_says_why() -> None:
    with pytest.raises(ConfigError, match=r"refine is on, but CNNRNN returns poses relative to a clip's first frame"):
        CNNRNN(input_shape=[20, 64], refine=True)
    with pytest.raises(ConfigError, match=r"refine is on, but LandmarkMap is a map itself; leave it out"):
        LandmarkMap(input_shape=[50, 68], refine=True)


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"keypoints": "SURFACE"}, "keypoints is 'SURFACE'; give one of SURF, SIFT, ORB, AKAZE, FREAK, BRIEF"),
        ({"n_features": 0}, "n_features is 0"),
        ({"bundle_adjust": "no"}, "bundle_adjust is 'no'; give true, false or auto"),
    ],
)
def test_settings_that_are_not_understood_are_refused(settings: dict[str, Any], problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        LinearPoseNet(input_shape=[16], refine=settings)  # type: ignore[arg-type]
