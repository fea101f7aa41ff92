"""When training counts as diverged, and when a rough start does not."""

from __future__ import annotations

import pytest
import torch

from lightning_pose.errors import ConfigError
from lightning_pose.models.parts import divergence
from lightning_pose.models.parts.divergence import DivergenceWatch

FRAMES = torch.tensor([4])


def watch_steps(*errors: float, loss: float = 1.0) -> DivergenceWatch:
    watch = DivergenceWatch()
    watch.spread_m = 1.0
    for error in errors:
        watch.add_step(torch.tensor(loss), torch.tensor([[error, 0.0, 0.0]]), torch.zeros(1, 3), FRAMES, "lower it")
    return watch


def test_a_rough_start_goes_on() -> None:
    watch = watch_steps(500.0, 3000.0, 1.0)  # far from the origin, without standardization
    watch.check_epoch("")
    watch.check_weights([torch.zeros(3)], "")


@pytest.mark.parametrize("errors", [(1.0, 1e6), (1.0, float("nan")), (float("nan"),)])
def test_errors_that_explode(errors: tuple[float, ...]) -> None:
    with pytest.raises(ConfigError, match=r"training has diverged.*lower it"):
        watch_steps(*errors).check_epoch("lower it")


@pytest.mark.parametrize("loss", [float("nan"), float("inf")])
def test_a_loss_that_is_no_number(loss: float) -> None:
    with pytest.raises(ConfigError, match=rf"the loss is {loss} in batch 1 of the epoch \(frames 4\); lower it"):
        watch_steps(1.0, loss=loss).check_epoch("lower it")


def test_the_batch_and_its_frames_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also before the end of a long epoch."""
    monkeypatch.setattr(divergence, "MOST_STEPS", 4)
    watch = DivergenceWatch("seq-01/{}.png".format)
    losses = [torch.tensor(value) for value in (1.0, 1.0, 1.0, 1.0, 1.0, torch.nan, torch.nan)]
    for loss in losses:
        watch.add_step(loss, torch.zeros(5, 3), torch.zeros(5, 3), torch.tensor([5, 3, 2, 1, 9]), "lower it")
    with pytest.raises(
        ConfigError, match=r"batch 6 of the epoch \(frames seq-01/1.png, seq-01/2.png, seq-01/3.png, \.\.\."
    ):
        watch.add_step(losses[0], torch.zeros(5, 3), torch.zeros(5, 3), torch.tensor([0]), "lower it")


def test_weights_that_are_no_numbers() -> None:
    with pytest.raises(ConfigError, match="weights are not finite"):
        watch_steps(1.0).check_weights([torch.zeros(2), torch.tensor([0.0, torch.inf])], "")


def test_a_training_that_ends_worse_than_it_began() -> None:
    for ends, grown in ((5.0, True), (2.0, False), (0.5, False)):
        watch = DivergenceWatch()
        watch.spread_m = 1.0
        for error in (1.0, ends):
            watch.add_step(torch.tensor(error), torch.tensor([[error, 0.0, 0.0]]), torch.zeros(1, 3), FRAMES, "")
            watch.check_epoch("")
        growth = watch.describe_growth()
        assert (growth is not None) == grown
        assert growth is None or "grew from 1 in the first epoch to 5 in the last" in growth


def test_a_far_start_or_a_single_epoch_is_no_growth() -> None:
    watch = watch_steps(50.0)
    assert watch.describe_growth() is None
    watch.check_epoch("")
    assert watch.describe_growth() is None


def test_one_training_frame_sets_no_bound_to_the_others() -> None:
    watch = DivergenceWatch()
    watch.add_step(torch.tensor(0.0), torch.zeros(1, 3), torch.zeros(1, 3), FRAMES, "")
    watch.check_error(0.5, "")


def test_frames_at_one_place() -> None:
    watch = DivergenceWatch()
    watch.add_step(torch.tensor(0.0), torch.zeros(1, 3), torch.zeros(1, 3), FRAMES, "")
    watch.add_step(torch.tensor(0.0), torch.full((1, 3), 1e-4), torch.zeros(1, 3), FRAMES, "")
    watch.check_epoch("")
