"""PoseModule: the scale of its answers, the hemisphere of its targets, its schedules, its refusals."""

from __future__ import annotations

import logging
import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from lightning_pose.data.batches import PoseBatch
from lightning_pose.errors import CheckpointError, ConfigError, DataError
from lightning_pose.losses import LossConfig
from lightning_pose.models import PoseModule, SurfCNN, SurfLSTM
from lightning_pose.models.parts.poses import check_features
from tests.models.helpers import LearnableProblem, features_for, make_model, random_poses

HALF = 0.5**0.5
EIGHTH = math.pi / 8


def tiny(**settings: object) -> PoseModule:
    return make_model(SurfLSTM, units=4, layers=1, **settings)


def test_scale_of_hand_computed_poses() -> None:
    model = tiny()
    position_m = torch.tensor([[1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    quat_wxyz = torch.tensor([[1.0, 0.0, 0.0, 0.0], [-HALF, -HALF, 0.0, 0.0]])  # none, and 90 degrees about x, flipped
    model.fit_scale(position_m, quat_wxyz)
    torch.testing.assert_close(model.quat_reference.abs(), torch.tensor([math.cos(EIGHTH), math.sin(EIGHTH), 0.0, 0.0]))
    sign = model.quat_reference[0].sign()
    mean_quat = sign * torch.tensor([(1 + HALF) / 2, HALF / 2, 0.0, 0.0])
    torch.testing.assert_close(model.pose_mean, torch.cat([torch.tensor([2.0, 0.0, 0.0]), mean_quat]))
    # Deviations of 1 m along one axis of three; of (1 - HALF) / 2 and HALF / 2 along two axes of four.
    torch.testing.assert_close(model.pose_scale[:3], torch.full((3,), (1 / 3) ** 0.5))
    torch.testing.assert_close(model.pose_scale[3:], torch.full((4,), ((1 - HALF) / 8) ** 0.5))


def test_without_standardize_only_the_hemisphere_is_learnt() -> None:
    model = tiny(standardize=False)
    model.fit_scale(torch.tensor([[4.0, 5.0, 6.0]]), torch.tensor([[0.0, 0.0, 0.0, 1.0]]))
    torch.testing.assert_close(model.pose_mean, torch.zeros(7))
    torch.testing.assert_close(model.pose_scale, torch.ones(7))
    torch.testing.assert_close(model.quat_reference.abs(), torch.tensor([0.0, 0.0, 0.0, 1.0]))


def test_poses_that_are_all_equal_have_a_scale() -> None:
    model = tiny()
    model.fit_scale(torch.ones(3, 3), torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(3, 1))
    assert (model.pose_scale > 0).all()
    position_m, _ = model.eval()(torch.zeros(1, *model.input_shape))
    torch.testing.assert_close(position_m.float(), torch.ones(1, 3), atol=1e-4, rtol=0)


def test_signs_of_quaternions_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    position_m, quat_wxyz = random_poses(16)
    flipped = quat_wxyz * torch.where(torch.arange(16) % 2 == 0, 1.0, -1.0)[:, None]
    features = torch.randn(16, 20, 64, generator=torch.Generator().manual_seed(0))
    losses = []
    for quats in (quat_wxyz, flipped):
        model = tiny()
        monkeypatch.setattr(model, "log_dict", lambda *args, **kwargs: None)
        model.fit_scale(position_m, quats)
        loss = model.training_step(PoseBatch(features, position_m, quats, torch.arange(16)), 0)
        assert loss is not None
        losses.append(loss.item())
    assert losses[1] == pytest.approx(losses[0], rel=1e-5)


def test_loss_settings_are_plain_in_hyperparameters() -> None:
    model = tiny(loss=LossConfig(form="split", orientation_weight=10.0))
    assert model.hparams["loss"]["orientation_weight"] == 10.0
    assert type(model.hparams["loss"]) is dict
    assert model.loss.config == LossConfig(form="split", orientation_weight=10.0)


def test_learned_weights_of_the_loss_are_trained() -> None:
    names = dict(tiny(loss=LossConfig(form="split", learned_weights=True)).named_parameters())
    assert {"loss.log_scale_position", "loss.log_scale_orientation"} <= names.keys()


def test_the_cosine_schedule_warms_up_and_ends_at_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny(learning_rate=1.0, schedule="cosine")
    monkeypatch.setattr(PoseModule, "trainer", type("Steps", (), {"estimated_stepping_batches": 100})())
    settings = model.configure_optimizers()
    assert isinstance(settings, dict)
    optimizer, schedule = settings["optimizer"], settings["lr_scheduler"]
    assert isinstance(schedule, dict)
    scheduler = schedule["scheduler"]
    assert isinstance(scheduler, torch.optim.lr_scheduler.LambdaLR)
    rates = []
    for _ in range(100):
        rates.append(scheduler.get_last_lr()[0])
        optimizer.step()
        scheduler.step()
    assert rates[:6] == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0, 1.0])
    assert all(a >= b for a, b in pairwise(rates[5:]))
    assert rates[-1] < 1e-3
    assert scheduler.get_last_lr()[0] == pytest.approx(0, abs=1e-12)


def test_the_constant_schedule_has_no_scheduler() -> None:
    assert isinstance(tiny(schedule="constant").configure_optimizers(), torch.optim.AdamW)


@pytest.mark.parametrize(("name", "value"), [("learning_rate", 0.0), ("learning_rate", -1.0), ("weight_decay", -0.1)])
def test_rates_out_of_range_are_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=rf"{name} is {value}; give"):
        tiny(**{name: value})


def test_a_checkpoint_of_another_architecture_is_refused() -> None:
    saved = {"lightning_pose": {"model": make_model(SurfCNN).describe()}, "state_dict": {}}
    with pytest.raises(CheckpointError, match="holds a SurfCNN, not a SurfLSTM; give the config"):
        tiny().on_load_checkpoint(saved)


def test_a_checkpoint_of_another_width_is_refused() -> None:
    saved = {"state_dict": SurfLSTM(input_shape=[20, 68], units=4, layers=1).state_dict()}
    with pytest.raises(CheckpointError, match=r"\(1, 68\) in the checkpoint and \(1, 64\) here; .*data.extractor"):
        tiny().on_load_checkpoint(saved)


def test_features_are_read_in_standard_deviations_and_empty_rows_do_not_count() -> None:
    model = SurfLSTM(input_shape=[2, 3])
    features = torch.tensor([[[1.0, 10.0, 5.0], [0.0, 0.0, 0.0]], [[3.0, 30.0, 5.0], [5.0, 50.0, 5.0]]])
    model.fit_feature_scale(features)
    np.testing.assert_allclose(model.feature_mean, [[3.0, 30.0, 5.0]])
    np.testing.assert_allclose(model.feature_scale, [[2.0, 20.0, 1e-6]], rtol=1e-6)


def test_features_are_read_as_they_are_without_standardize_features() -> None:
    model = SurfLSTM(input_shape=[2, 3], standardize_features=False)
    model.fit_feature_scale(torch.randn(4, 2, 3))
    np.testing.assert_allclose(model.feature_mean, np.zeros((1, 3)))
    np.testing.assert_allclose(model.feature_scale, np.ones((1, 3)))


def test_rows_that_fill_up_a_frame_stay_zero() -> None:
    model = make_model(SurfCNN)
    features = features_for(model, 6) + 3
    features[:, 15:] = 0
    model.fit_feature_scale(features)
    standardized = model.standardize_input(features)
    assert not standardized[:, 15:].any()
    assert standardized[:, :15].mean().abs() < 1e-5


def test_filling_rows_do_not_change_an_unordered_answer() -> None:
    torch.manual_seed(0)
    short, long = (SurfCNN(input_shape=[rows, 64], ordered=False).eval() for rows in (12, 20))
    long.load_state_dict(short.state_dict())
    features = torch.randn(3, 12, 64)
    padded = torch.cat([features, torch.zeros(3, 8, 64)], dim=1)
    torch.testing.assert_close(long(padded).position_m, short(features).position_m, atol=1e-5, rtol=1e-5)


def test_frames_without_features_are_counted_or_refused(caplog: pytest.LogCaptureFixture) -> None:
    data = LearnableProblem([20, 64]).data.data
    data.features[:3] = 0
    check_features(data)
    assert "3 of 24 training frames have no features" in caplog.text
    data.features[:20] = 0
    with pytest.raises(DataError, match=r"20 of 24 training frames have no features.*check"):
        check_features(data)


def test_frames_with_fewer_features_than_asked_for_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    features = torch.ones(4, 5, 2)
    features[1, 3:] = 0
    features[2, 1:] = 0
    data = PoseBatch(features, torch.zeros(4, 3), torch.zeros(4, 4), torch.arange(4))
    with caplog.at_level(logging.WARNING, "lightning_pose"):
        check_features(data)
        assert caplog.text == ""
        check_features(data, local=True)
    assert "2 of 4 training frames have fewer than 5 features (median 1, least 1)" in caplog.text
