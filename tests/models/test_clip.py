"""What models of clips share: steps, motion, scale, the layers' responses, causality."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from lightning import Trainer
from torch import Tensor

from lightning_pose.errors import ConfigError
from lightning_pose.evaluation.responses import record_responses
from lightning_pose.geometry.relative import relative_poses
from lightning_pose.models import CNN3D, CNNRNN, ClipModule
from lightning_pose.models.parts.motion import measure_motion
from tests.models.helpers import ClipProblem, features_for

NETWORKS: list[type[ClipModule]] = [CNNRNN, CNN3D]
every_network = pytest.mark.parametrize("network", NETWORKS, ids=lambda cls: cls.__name__)


def make(network: type[ClipModule], shape: list[int] | None = None, **settings: Any) -> ClipModule:
    torch.manual_seed(0)
    return network(input_shape=shape or [6, 12], **{"channels": 8, "units": 16, **settings})


def seen_points(frames: int = 3, points: int = 6) -> Tensor:
    """(1, T, N, 8 + 4) features: each point has its own descriptor and goes right by 0.1 a frame."""
    features = torch.zeros(1, frames, points, 12)
    features[..., :8] = torch.eye(8)[:points]
    features[..., 8] = torch.linspace(-0.8, 0.4, points) + 0.1 * torch.arange(frames)[:, None]
    features[..., 9] = torch.linspace(0.3, -0.3, points)
    return features


@every_network
@pytest.mark.parametrize("length", [2, 7, 40])
def test_one_set_of_weights_takes_clips_of_any_length(network: type[ClipModule], length: int) -> None:
    position_m, quat_wxyz = make(network).eval()(torch.randn(2, length, 6, 12))
    assert position_m.shape == (2, length, 3)
    assert quat_wxyz.shape == (2, length, 4)


@every_network
@pytest.mark.parametrize("shape", [[1, 64], [3, 64], [50, 64], [3, 32, 40]])
def test_from_one_descriptor_to_raw_images(network: type[ClipModule], shape: list[int]) -> None:
    assert make(network, shape).eval()(torch.rand(1, 3, *shape)).position_m.shape == (1, 3, 3)


@pytest.mark.parametrize(("network", "n_features", "count"), [
    (CNNRNN, 50, 64 * 50 + 64 * 577 + 4 * 64 + 8 * 100 * (64 * 13 * 16 + 100 + 2) + 7 * 201),
    (CNN3D, 50, 64 * 28 + 64 * (64 * 27 + 1) + 1000 * (64 * 2 * 3 + 1) + 7 * 1001),
])  # fmt: skip
def test_layers_of_the_thesis(network: type[ClipModule], n_features: int, count: int) -> None:
    model = network(input_shape=[n_features, 64])
    assert sum(parameter.numel() for parameter in model.network.parameters()) == count


@every_network
def test_integrated_steps_begin_at_the_origin_and_add_up(network: type[ClipModule]) -> None:
    model = make(network, integrate=True).eval()
    features = torch.randn(1, 5, 6, 12)
    position_m, quat_wxyz = model(features)
    torch.testing.assert_close(position_m[:, 0], torch.zeros(1, 3).double())
    torch.testing.assert_close(quat_wxyz[:, 0], torch.eye(4)[:1])
    steps, _ = model.unscale_pose(model.network(model.standardize_input(features).unsqueeze(2)))
    torch.testing.assert_close(position_m[:, 1], steps[:, 1].double())


def test_integrated_networks_learn_the_scale_of_steps_and_others_that_of_clips() -> None:
    problem = ClipProblem([6, 12])
    trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    trainer.datamodule = problem  # type: ignore[attr-defined]
    position_m, quat_wxyz = problem.training_clips.targets()
    for integrate in (False, True):
        model = make(CNNRNN, integrate=integrate)
        model.trainer = trainer
        model.setup("fit")
        steps = [relative_poses(position_m[:, i : i + 2], quat_wxyz[:, i : i + 2])[0][:, 1] for i in range(3)]
        expected = torch.stack(steps, 1) if integrate else position_m[:, 1:]
        torch.testing.assert_close(model.pose_mean[:3], expected.flatten(0, 1).mean(0))


def test_metrics_leave_out_the_first_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, model = ClipProblem([6, 12]), make(CNN3D).eval()
    monkeypatch.setattr(model, "log_dict", lambda *args, **kwargs: None)
    model.validation_step(problem.learnt, 0)
    (errors,) = model.val_metrics.position_error_m
    assert len(errors) == problem.learnt.frame[:, 1:].numel()


def test_motion_is_that_of_each_point() -> None:
    rows = measure_motion(seen_points())
    assert rows.shape == (1, 3, 6, 5)
    assert not rows[:, 0].any(), "the first frame has none before it"
    torch.testing.assert_close(rows[0, 1:, :, 2], torch.full((2, 6), 0.1))
    assert rows[0, 1:, :, 3:].abs().max() < 1e-6
    assert (rows[0, 2, :, 0].diff() > 0).all(), "in the order of x"
    torch.testing.assert_close(rows[0, 2, :, 1], torch.linspace(0.3, -0.3, 6))


def test_motion_does_not_depend_on_the_order_of_features() -> None:
    features = seen_points()
    mixed = torch.stack([frame[torch.randperm(6)] for frame in features[0]])[None]
    torch.testing.assert_close(measure_motion(mixed), measure_motion(features))


def test_features_without_a_match_do_not_move() -> None:
    features = seen_points()
    features[0, 1, 2, :8] = torch.eye(8)[7]  # another point than any before
    features[0, 1, 3, :8] = 0  # a frame with fewer features
    features[0, 1, 4, 8] = 2.0  # a jump across the image is no motion
    rows = measure_motion(features)
    assert (rows[0, 1].any(-1)).tolist() == [True] * 3 + [False] * 3


def test_motion_has_a_scale_of_its_own() -> None:
    problem = ClipProblem([6, 12])
    features = seen_points(24)[0]
    features[..., 8] -= features[..., 8].floor()  # whoever leaves to the right comes back
    problem.training_clips.data.features.copy_(features)
    model = make(CNN3D, motion=True)
    trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    trainer.datamodule = problem  # type: ignore[attr-defined]
    model.trainer = trainer
    model.setup("fit")
    assert 0 < model.motion_scale[2] < 0.5
    assert model.image_shape == (5, 6, 1)


@pytest.mark.parametrize("settings", [{"shape": [3, 32, 32]}, {"shape": [6, 4]}])
def test_motion_needs_places(settings: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"model\.motion needs descriptors with their places"):
        make(CNN3D, motion=True, **settings)


def test_steps_need_camera_axes() -> None:
    model, problem = make(CNN3D, integrate=True), ClipProblem([6, 12])
    problem.relative_frame = "world"
    model.trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    model.trainer.datamodule = problem  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match=r"data\.relative_frame is world; set camera"):
        model.setup("fit")


@pytest.mark.parametrize("model", [
    make(CNNRNN, bidirectional=False), make(CNN3D, causal=True), make(CNN3D, causal=True, motion=True, integrate=True)
], ids=["rnn", "3d", "3d motion"])  # fmt: skip
def test_a_causal_network_answers_before_the_next_frame_comes(model: ClipModule) -> None:
    features = features_for(model, 1).repeat(1, 3, 1, 1)
    whole = model.eval()(features).position_m
    torch.testing.assert_close(model(features[:, :7]).position_m, whole[:, :7], atol=1e-5, rtol=1e-5)


@every_network
def test_others_depend_on_later_frames(network: type[ClipModule]) -> None:
    model = make(network).eval()
    features = features_for(model, 1).repeat(1, 3, 1, 1)
    assert not torch.allclose(model(features[:, :7]).position_m[:, 6], model(features).position_m[:, 6], atol=1e-5)


@every_network
def test_responses_of_the_first_two_layers(network: type[ClipModule]) -> None:
    model = make(network, [3, 32, 40]).train()
    found = record_responses(model, torch.rand(4, 3, 32, 40))
    assert list(found) == ["convolution 1", "activation 1", "convolution 2", "activation 2"]
    assert found["convolution 1"].shape == found["activation 1"].shape == (4, 8, 32, 40)
    torch.testing.assert_close(found["activation 2"], found["convolution 2"].relu())
    assert model.training, "left as it was"


@every_network
def test_widths_out_of_range_are_refused(network: type[ClipModule]) -> None:
    with pytest.raises(ConfigError, match=r"channels 0, units 16, dropout 0\.0: give 1 or more"):
        make(network, channels=0)
