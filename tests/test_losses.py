"""PoseLoss: each form of the thesis against a value computed by hand."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from lightning_pose.errors import ConfigError
from lightning_pose.losses import LossConfig, PoseLoss

IDENTITY = torch.tensor([1.0, 0.0, 0.0, 0.0])

# Two frames: position errors of norm 5 and 0, quaternion errors of norm 1 and 2.
POSITION_HAT = torch.tensor([[3.0, 4.0, 0.0], [1.0, 1.0, 1.0]])
POSITION = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
QUAT_HAT = torch.tensor([[1.0, 1.0, 0.0, 0.0], [3.0, 0.0, 0.0, 0.0]])
QUAT = IDENTITY.expand(2, 4)

# One clip of two frames: position errors (3, 0, 0) and (0, 4, 0), whose sum has norm 5; exact quaternions.
CLIP_HAT = torch.tensor([[[3.0, 0.0, 0.0], [0.0, 4.0, 0.0]]])
CLIP = torch.zeros(1, 2, 3)
CLIP_QUAT = IDENTITY.expand(1, 2, 4)


def loss(**settings: Any) -> dict[str, torch.Tensor]:
    return PoseLoss(LossConfig(**settings))(POSITION_HAT, QUAT_HAT, POSITION, QUAT)


def clip_loss(**settings: Any) -> dict[str, torch.Tensor]:
    return PoseLoss(LossConfig(**settings))(CLIP_HAT, CLIP_QUAT, CLIP, CLIP_QUAT)


@pytest.mark.parametrize(
    ("settings", "total"),
    [
        pytest.param({}, (math.sqrt(26) + 2) / 2, id="eq. 2.1 and 3.7"),
        pytest.param({"orientation_weight": 3}, (math.sqrt(34) + 6) / 2, id="joint, weighted"),
        pytest.param({"norm": "squared"}, (26 + 4) / 2, id="joint, squared"),
        pytest.param({"form": "split", "orientation_weight": 10}, 2.5 + 10 * 1.5, id="eq. 4.4"),
        pytest.param(
            {"form": "split", "orientation_weight": 10, "normalize_quat": True},
            2.5 + 10 * math.sqrt(2 - math.sqrt(2)) / 2,
            id="eq. 5.3",
        ),
        pytest.param({"form": "split", "norm": "squared", "orientation_weight": 200}, 12.5 + 200 * 2.5, id="eq. 6.3"),
        pytest.param({"form": "split", "learned_weights": True}, 2.5 + 1.5 * math.exp(3) - 3, id="learned weights"),
    ],
)
def test_total_by_hand(settings: dict[str, Any], total: float) -> None:
    assert loss(**settings)["total"].item() == pytest.approx(total)


@pytest.mark.parametrize("form", ["joint", "split"])
def test_terms_are_unweighted(form: str) -> None:
    plain = loss(form=form, orientation_weight=7)
    assert (plain["position"].item(), plain["orientation"].item()) == (2.5, 1.5)
    squared = loss(form=form, norm="squared", orientation_weight=7)
    assert (squared["position"].item(), squared["orientation"].item()) == (12.5, 2.5)
    assert "trajectory" not in plain


def test_trajectory_is_eq_6_2_per_frame() -> None:
    terms = clip_loss(form="split", norm="squared", orientation_weight=200, trajectory_weight=1)
    assert terms["trajectory"].item() == pytest.approx(25 / 2)
    assert terms["total"].item() == pytest.approx((9 + 16 + 25) / 2)


@pytest.mark.parametrize("form", ["joint", "split"])
def test_trajectory_plain_norm(form: str) -> None:
    terms = clip_loss(form=form, trajectory_weight=2)
    assert terms["trajectory"].item() == pytest.approx(5 / 2)
    assert terms["total"].item() == pytest.approx((3 + 4) / 2 + 2 * 5 / 2)


def test_trajectory_shares_the_learned_weight_of_position() -> None:
    module = PoseLoss(LossConfig(form="split", learned_weights=True, trajectory_weight=2))
    with torch.no_grad():
        module.log_scale_position.fill_(math.log(2))
    total = module(CLIP_HAT, CLIP_QUAT, CLIP, CLIP_QUAT)["total"].item()
    assert total == pytest.approx((3.5 + 2 * 2.5) / 2 + math.log(2) - 3)


def test_learned_weights_are_parameters_and_get_gradients() -> None:
    module = PoseLoss(LossConfig(form="split", learned_weights=True))
    assert {name: p.item() for name, p in module.named_parameters()} == {
        "log_scale_position": 0.0,
        "log_scale_orientation": -3.0,
    }
    module(POSITION_HAT, QUAT_HAT, POSITION, QUAT)["total"].backward()
    assert all(p.grad is not None and p.grad.item() != 0 for p in module.parameters())
    assert not list(PoseLoss().parameters())


@pytest.mark.parametrize("form", ["joint", "split"])
@pytest.mark.parametrize("norm", ["plain", "squared"])
@pytest.mark.parametrize("normalize_quat", [False, True])
def test_gradient_is_finite_at_zero_error(form: str, norm: str, normalize_quat: bool) -> None:
    position_hat, quat_hat = CLIP.clone().requires_grad_(), CLIP_QUAT.clone().requires_grad_()
    settings: dict[str, Any] = {"form": form, "norm": norm, "normalize_quat": normalize_quat}
    terms = PoseLoss(LossConfig(**settings, trajectory_weight=1))(position_hat, quat_hat, CLIP, CLIP_QUAT)
    terms["total"].backward()
    assert terms["total"].item() == 0
    for tensor in (position_hat, quat_hat):
        assert tensor.grad is not None
        assert tensor.grad.isfinite().all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"form": "both"}, "form is 'both'; give one of joint, split"),
        ({"norm": "l1"}, "norm is 'l1'; give one of plain, squared"),
        ({"orientation_weight": -1}, "orientation_weight is -1; give"),
        ({"trajectory_weight": float("nan")}, "trajectory_weight is nan; give"),
        ({"learned_weights": True}, "form is 'joint'; set form: split"),
        (
            {"learned_weights": True, "form": "split", "orientation_weight": 10},
            "weight is 10 .* set",
        ),
    ],
)
def test_contradictory_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        LossConfig(**settings)


def test_trajectory_without_time_axis_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"trajectory_weight is 0.5 .*\(2, 3\).* set trajectory_weight: 0"):
        loss(trajectory_weight=0.5)


def test_shapes_that_would_broadcast_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"\(1, 2, 3\).*give both the same shape"):
        PoseLoss()(CLIP_HAT, CLIP_QUAT, POSITION, QUAT)
