"""What every exported architecture must do; a new one is picked up from `lightning_pose.models` by itself."""

from __future__ import annotations

import io
import math
from typing import Any

import pytest
import torch
from lightning import Trainer

from lightning_pose.checkpoint import build_object
from lightning_pose.data.batches import PoseBatch, make_loader
from lightning_pose.errors import ConfigError
from lightning_pose.geometry.quaternions import orientation_error_deg, position_error_m
from lightning_pose.losses import LossConfig
from lightning_pose.models import (
    CNN3D,
    CNNRNN,
    ClipModule,
    DensePoseNet,
    KernelPoseNet,
    LinearPoseNet,
    PoseModule,
    SurfCNN,
)
from tests.models.helpers import (
    ARCHITECTURES,
    CLIP_LENGTH,
    ClipProblem,
    LearnableProblem,
    WallProblem,
    features_for,
    make_model,
    problem_for,
    random_poses,
)

Architecture = type[PoseModule]
every_architecture = pytest.mark.parametrize("architecture", ARCHITECTURES, ids=lambda cls: cls.__name__)


SMALL: dict[Architecture, dict[str, Any]] = {
    CNN3D: {"channels": 16, "units": 100, "learning_rate": 3e-3},
    CNNRNN: {"channels": 16, "units": 50, "learning_rate": 3e-3},
    SurfCNN: {"channels": [32, 64], "kernels": [7, 5], "units": 200},
}
"""Widths that learn as the defaults do, in a tenth of the time."""


def frames_of(model: PoseModule, count: int) -> tuple[int, ...]:
    """(B,) frames, or (B, T) where the model reads clips."""
    return (count, CLIP_LENGTH) if isinstance(model, ClipModule) else (count,)


@every_architecture
@pytest.mark.parametrize("standardize", [True, False])
def test_poses_have_their_shape_and_unit_quaternions(architecture: Architecture, standardize: bool) -> None:
    model = make_model(architecture, standardize=standardize).eval()
    model.fit_scale(*random_poses(10))
    position_m, quat_wxyz = model(features_for(model, 5))
    assert position_m.shape == (*frames_of(model, 5), 3)
    assert quat_wxyz.shape == (*frames_of(model, 5), 4)
    torch.testing.assert_close(quat_wxyz.norm(dim=-1), torch.ones(frames_of(model, 5)))


@every_architecture
def test_a_blank_image_has_a_finite_pose(architecture: Architecture) -> None:
    model = make_model(architecture).eval()
    pose = model(torch.zeros_like(features_for(model, 1)))
    assert all(tensor.isfinite().all() for tensor in pose)


@every_architecture
def test_a_frame_alone_is_located_as_in_a_batch(architecture: Architecture) -> None:
    model = make_model(architecture).eval()
    features = features_for(model, 4)
    torch.testing.assert_close(model(features[1:2]).position_m, model(features).position_m[1:2], atol=1e-5, rtol=1e-5)


@every_architecture
def test_every_parameter_gets_a_finite_gradient(architecture: Architecture, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(architecture)
    if not model.automatic_optimization:
        pytest.skip("solved in closed form")
    monkeypatch.setattr(model, "log_dict", lambda *args, **kwargs: None)
    frames = frames_of(model, 8)
    position_m, quat_wxyz = (pose.unflatten(0, frames) for pose in random_poses(math.prod(frames)))
    batch = PoseBatch(features_for(model, 8), position_m, quat_wxyz, torch.arange(8))
    loss = model.training_step(batch, 0)
    assert loss is not None
    loss.backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name


@every_architecture
def test_a_checkpoint_rebuilds_the_same_model(architecture: Architecture) -> None:
    model = make_model(architecture, learning_rate=0.02).eval()
    model.fit_scale(*random_poses(10))
    file = io.BytesIO()
    torch.save({"spec": model.describe(), "state_dict": model.state_dict()}, file)
    file.seek(0)
    saved: dict[str, Any] = torch.load(file, weights_only=True)  # plain types only, or this refuses
    rebuilt: PoseModule = build_object(saved["spec"], allow="tests")
    rebuilt.load_state_dict(saved["state_dict"])
    assert type(rebuilt) is architecture
    assert rebuilt.learning_rate == 0.02
    assert rebuilt.describe() == model.describe()
    features = features_for(model, 3)
    torch.testing.assert_close(rebuilt.eval()(features), model(features), atol=0, rtol=0)


@every_architecture
def test_features_of_another_rank_are_refused(architecture: Architecture) -> None:
    shape = [3] * (architecture.input_ranks[-1] + 1)
    with pytest.raises(ConfigError, match=rf"{architecture.__name__} .*\(3, 3.*choose another data.extractor"):
        architecture(input_shape=shape)


@every_architecture
def test_a_run_has_a_headline(architecture: Architecture) -> None:
    assert make_model(architecture).headline


@every_architecture
def test_it_learns_what_can_be_learnt(architecture: Architecture) -> None:
    model = make_model(architecture, loss=LossConfig(orientation_weight=5.0), **SMALL.get(architecture, {}))
    problem = problem_for(model)
    trainer = Trainer(
        max_epochs=100 if architecture is CNN3D else 25,  # averages over patches learn slowly
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(model, datamodule=problem)
    data = problem.learnt
    with torch.inference_mode():
        position_m, quat_wxyz = model.eval()(data.features)
    mean_pose_error = position_error_m(data.position_m.flatten(0, -2).mean(0), data.position_m).median()
    assert position_error_m(position_m, data.position_m).median() < mean_pose_error / 3
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0])
    turned = orientation_error_deg(upright, data.quat_wxyz).median()
    assert orientation_error_deg(quat_wxyz, data.quat_wxyz).median() < turned / 3


CLOSED_FORMS: list[tuple[Architecture, dict[str, Any]]] = [
    (LinearPoseNet, {"lambdas": [1.0, 10.0], "refit": True, "components": 4}),
    (KernelPoseNet, {"lambdas": [0.1, 1.0], "refit": True}),
    (DensePoseNet, {"components": 4}),
]


@pytest.mark.parametrize(("architecture", "settings"), [*((cls, {}) for cls in ARCHITECTURES), *CLOSED_FORMS], ids=str)
def test_fitting_does_not_read_the_test_split(
    architecture: Architecture, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = make_model(architecture, **settings)
    problem = problem_for(model)
    monkeypatch.setattr(problem, "val_dataloader", lambda: make_loader(problem.dataset("val"), 8, shuffle=False))
    read: list[str] = []
    dataset = problem.dataset
    monkeypatch.setattr(problem, "dataset", lambda split: read.append(split) or dataset(split))
    trainer = Trainer(
        max_epochs=1,
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(model, datamodule=problem)
    assert "val/loss" in trainer.callback_metrics
    assert "train" in read
    assert "test" not in read


@pytest.mark.parametrize("problem", [LearnableProblem([20, 5]), ClipProblem([20, 5]), WallProblem([250, 36])])
def test_no_frame_of_a_problem_is_in_two_splits(problem: LearnableProblem) -> None:
    data = [problem.splits[split].data for split in ("train", "val", "test")]
    for tensors in zip(*data, strict=True):
        rows = torch.cat([tensor.flatten(1) if tensor.ndim > 1 else tensor[:, None] for tensor in tensors])
        assert len(rows.unique(dim=0)) == len(rows)
