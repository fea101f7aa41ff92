"""Origin and scale: small numbers for networks, float64 in the world, and the same for a scene that was moved."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
import torch
from lightning import Trainer

from lightning_pose.checkpoint import build_object, read_checkpoint
from lightning_pose.data.batches import PoseDataset
from lightning_pose.data.clip_dataset import ClipDataset, ClipShape
from lightning_pose.models import CNNRNN, KernelPoseNet, LinearPoseNet, NodePose, PoseModule, SurfLSTM
from lightning_pose.models.parts.world_frame import WorldFrame
from tests.models.helpers import ClipProblem, LearnableProblem, make_model, problem_for, random_poses

UTM = torch.tensor([503123.45, 5413876.11, 431.2], dtype=torch.float64)
MILLION = torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64)


def fitted(position_m: torch.Tensor, centred: bool = True) -> WorldFrame:
    frame = WorldFrame(centred)
    frame.fit(position_m)
    return frame


def room() -> torch.Tensor:
    return random_poses(200)[0].double()


def test_a_scene_in_metres_near_its_origin_is_seen_as_it_is() -> None:
    frame = fitted(room())
    assert frame.scale == 1
    assert not frame.origin.any()
    assert torch.equal(frame.to_local(room()), room())


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_round_shifts_and_other_units_have_the_same_local_positions(scale: float) -> None:
    frame = fitted((room() + MILLION) * scale)
    assert frame.scale == pytest.approx(scale)
    local = frame.to_local((room() + MILLION) * scale)
    torch.testing.assert_close(local, room(), atol=1e-9, rtol=0)
    torch.testing.assert_close(frame.to_world(local.float()), (room() + MILLION) * scale, atol=1e-6 * scale, rtol=0)


def test_geographic_coordinates_keep_their_digits() -> None:
    world = room() + UTM
    frame = fitted(world)
    local = frame.to_local(world).float()
    assert local.abs().max() < 20
    torch.testing.assert_close(frame.to_world(local), world, atol=2e-6, rtol=0)


@pytest.mark.parametrize("spread", [0.0, 0.05, 100.0])
def test_cameras_that_stand_still_and_streets_are_in_metres(spread: float) -> None:
    assert fitted(torch.randn(500, 3, dtype=torch.float64) * spread + 3).scale == 1


def test_relative_positions_have_a_scale_and_no_origin() -> None:
    frame = fitted(room() * 1000 + 1e9, centred=False)
    assert frame.scale == 1000
    assert not frame.origin.any()


def test_no_precision_setting_rounds_the_origin_and_older_checkpoints_have_none() -> None:
    model = make_model(LinearPoseNet)
    model.world_frame.fit(room() + UTM)
    state = model.half().state_dict()
    assert state["world_frame._extra_state"].dtype == torch.float64
    again = make_model(LinearPoseNet)
    again.load_state_dict(state)
    assert torch.equal(again.world_frame.origin, model.world_frame.origin)
    del state["world_frame._extra_state"]
    again.load_state_dict(state)
    assert not again.world_frame.origin.any()
    assert again.world_frame.scale == 1


def moved_problem(model: PoseModule, shift: torch.Tensor, scale: float) -> LearnableProblem:
    """The problem of `problem_for` in a world that is moved and in another unit; features stay as they are."""
    problem = problem_for(model)
    for split, data in problem.splits.items():
        world = (data.data.position_m.double() + shift) * scale
        problem.splits[split] = PoseDataset(data.data._replace(position_m=world))
    problem.data = problem.splits["train"]
    problem.learnt = problem.data.data
    if isinstance(problem, ClipProblem):
        features = problem.clip_splits["train"]
        shape = ClipShape(features.shape.length, hop=1)
        problem.clip_splits = {
            split: ClipDataset(data.data, features.runs, shape) for split, data in problem.splits.items()
        }
        shown = problem_for(model).learnt.features
        clips = problem.clip_splits["train"]
        problem.learnt = clips.__getitems__(range(len(clips)))._replace(features=shown)
    return problem


def trained(architecture: type[PoseModule], shift: torch.Tensor, scale: float) -> torch.Tensor:
    """Positions in the original world that a model predicts which was trained in the moved one."""
    torch.manual_seed(0)
    settings: dict[str, object] = {}
    if issubclass(architecture, LinearPoseNet | KernelPoseNet):
        settings = {"lambdas": [1e-3]}
    elif architecture is CNNRNN:
        settings = {"channels": 16, "units": 30}
    model = make_model(architecture, **settings)
    problem = moved_problem(model, shift, scale)
    trainer = Trainer(
        max_epochs=3,
        accelerator="cpu",
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        enable_checkpointing=False,
    )
    trainer.fit(model, datamodule=problem)
    with torch.no_grad():
        position_m = model.eval()(problem.learnt.features).position_m
    assert position_m.dtype == torch.float64
    return position_m / scale - (0 if model.reads_clips else shift)


@cache
def trained_still(architecture: type[PoseModule]) -> torch.Tensor:
    """Positions that a model predicts which was trained in the original world."""
    return trained(architecture, 0 * MILLION, 1.0)


@pytest.mark.parametrize(("shift", "scale"), [(MILLION, 1.0), (UTM, 1.0), (0 * MILLION, 1e-3), (0 * MILLION, 1e3)])
@pytest.mark.parametrize(
    ("architecture", "tolerance"),
    [(LinearPoseNet, 1e-6), (KernelPoseNet, 1e-6), (SurfLSTM, 1e-4), (NodePose, 1e-4), (CNNRNN, 1e-4)],
)
def test_a_moved_scene_trains_to_the_same_result(
    architecture: type[PoseModule], tolerance: float, shift: torch.Tensor, scale: float
) -> None:
    still, moved = trained_still(architecture), trained(architecture, shift, scale)
    spread = float((still - still.mean(0)).square().sum(-1).mean().sqrt())
    assert float((moved - still).abs().max()) < tolerance * max(spread, 1.0)


def test_a_checkpoint_carries_origin_and_scale(tmp_path: Path) -> None:
    model = make_model(LinearPoseNet, lambdas=[1e-3])
    problem = moved_problem(model, UTM, 1.0)
    trainer = Trainer(max_epochs=1, accelerator="cpu", logger=False, default_root_dir=tmp_path)
    trainer.fit(model, datamodule=problem)
    trainer.save_checkpoint(tmp_path / "utm.ckpt")
    checkpoint = read_checkpoint(tmp_path / "utm.ckpt")
    again = build_object(checkpoint["lightning_pose"]["model"]).eval()
    again.load_state_dict(checkpoint["state_dict"])
    features = problem.learnt.features
    with torch.no_grad():
        assert torch.equal(again(features).position_m, model(features).position_m)
    assert float((again(features).position_m - problem.learnt.position_m).norm(dim=1).median()) < 0.1
