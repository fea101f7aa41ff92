"""Radii of a regressor's errors, and the limit of distances: coverage, layouts of features, checkpoints."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from lightning_pose.data.batches import PoseBatch
from lightning_pose.errors import ConfigError
from lightning_pose.models import LinearPoseNet
from lightning_pose.models.parts.error_radius import ErrorRadius


def draw_frames(count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Features (count, 32) at several distances from (0, ..., 0, 1), and errors that grow with the distance."""
    generator = torch.Generator().manual_seed(seed)
    distance = torch.rand(count, generator=generator)
    features = torch.zeros(count, 32)
    features[:, 0], features[:, -1] = distance, 1.0
    noise = torch.randn(2, count, generator=generator).abs()
    return features, (distance + 0.1) * noise[0], 20 * (distance + 0.1) * noise[1]


@pytest.fixture
def calibrated() -> ErrorRadius:
    radius = ErrorRadius((32,))
    radius.set_training(torch.eye(32)[-1:] + 1e-3 * torch.eye(32)[:10])
    radius.add_errors(*draw_frames(300, seed=1))
    radius.calibrate(radius.take_scores())
    return radius


def test_nine_of_ten_errors_are_within_and_far_images_have_larger_radii(calibrated: ErrorRadius) -> None:
    features, position, orientation = draw_frames(2000, seed=2)
    radius, radius_deg = calibrated.find_radii(features)
    for error, found in ((position, radius), (orientation, radius_deg)):
        assert 0.86 < float((error <= found).float().mean()) < 0.94
    order = features[:, 0].argsort()
    assert radius[order[-200:]].mean() > 1.5 * radius[order[:200]].mean()


def test_it_is_unknown_before_and_from_few_frames() -> None:
    radius = ErrorRadius((32,))
    assert radius.find_radii(torch.zeros(3, 32))[0].isnan().all()
    radius.set_training(torch.eye(32))
    radius.add_errors(*draw_frames(5, seed=1))
    radius.calibrate(radius.take_scores())
    assert radius.find_radii(torch.zeros(3, 32))[1].isnan().all()
    radius.limit = 1.25
    assert radius.measure_excess(torch.zeros(3, 32)).isnan().all()


def test_images_beyond_the_limit_are_refused(calibrated: ErrorRadius) -> None:
    features = draw_frames(300, seed=1)[0]
    calibrated.limit = 1.0
    excess = calibrated.measure_excess(features)
    assert float(excess.max()) == pytest.approx(1.0), "the farthest validation frame is just accepted"
    calibrated.limit = 0.5
    torch.testing.assert_close(calibrated.measure_excess(features), 2 * excess)
    model = LinearPoseNet(input_shape=[32], distance_limit=0.5)
    assert model.radius is not None
    model.radius.load_state_dict(calibrated.state_dict())
    answers = model.locate_images(features, [(64, 48)] * 300)
    refused = 2 * excess.numpy() > 1
    assert refused.any()
    assert not refused.all()
    np.testing.assert_array_equal(np.isinf(answers.radius_m), refused)
    frames = PoseBatch(features, torch.zeros(300, 3), torch.zeros(300, 4), torch.arange(300))
    np.testing.assert_array_equal(model.find_refused(frames), refused)
    calibrated.limit = None
    assert calibrated.measure_excess(features).isnan().all()
    with pytest.raises(ConfigError, match=r"distance_limit is 0; give a number above 0, such as 1\.25, or null"):
        LinearPoseNet(input_shape=[32], distance_limit=0)


def test_a_checkpoint_of_plain_sums_answers_as_it_did() -> None:
    features = torch.rand(12, 20, 64, generator=torch.Generator().manual_seed(0))
    older = ErrorRadius((20, 64))
    older.lift, older.mean = None, torch.zeros(64)
    older.signs = torch.eye(64)[:, :16]
    older.set_training(features[:8])
    state = {**older.state_dict(), "reference": older.reference.float()}
    model = ErrorRadius((20, 64))
    model.load_state_dict(state)
    assert model.lift is None
    assert model.signs.shape == (64, 16)
    model.signs = older.signs
    torch.testing.assert_close(model.measure_distance(features), older.measure_distance(features))
    model.load_state_dict(ErrorRadius((20, 64)).state_dict())
    assert model.lift is not None


@pytest.mark.parametrize("shape", [(32,), (20, 64), (16, 7, 7), (3, 24, 24)])
def test_it_measures_any_layout(shape: tuple[int, ...]) -> None:
    radius = ErrorRadius(shape)
    features = torch.rand(12, *shape, generator=torch.Generator().manual_seed(0))
    radius.set_training(features[:8])
    distance = radius.measure_distance(features)
    assert distance.shape == (12,)
    assert distance[:8].max() < 1e-3 < distance[8:].min()


def test_a_checkpoint_carries_it_and_an_older_one_leaves_it_unknown(calibrated: ErrorRadius) -> None:
    features = draw_frames(4, seed=3)[0]
    other = ErrorRadius((32,))
    other.load_state_dict(calibrated.state_dict())
    torch.testing.assert_close(other.find_radii(features), calibrated.find_radii(features))
    model = LinearPoseNet(input_shape=[32])
    older = {name: value for name, value in model.state_dict().items() if not name.startswith("radius.")}
    model.on_load_checkpoint({"state_dict": older})
    model.load_state_dict(older)
    assert model.locate_images(features, [(64, 48)] * 4).radius_m.shape == (4,)


def test_a_checkpoint_of_sixteen_numbers_an_image_answers_as_it_did(calibrated: ErrorRadius) -> None:
    features = draw_frames(4, seed=3)[0]
    older = {name: value for name, value in calibrated.state_dict().items() if name != "farthest"}
    signs = np.unpackbits(np.random.PCG64(0).random_raw(32 * 16 // 64).view(np.uint8)).reshape(32, 16) / 2.0 - 0.25
    unit = F.normalize(features, dim=1) - calibrated.mean
    older["reference"] = unit[:1] @ torch.from_numpy(signs).float()
    other = ErrorRadius((32,), limit=1.25)
    other.load_state_dict(older)
    expected = ((unit - unit[:1]) @ torch.from_numpy(signs).float()).norm(dim=1)
    torch.testing.assert_close(other.measure_distance(features), expected, atol=1e-6, rtol=1e-5)
    assert other.measure_excess(features).isnan().all()
