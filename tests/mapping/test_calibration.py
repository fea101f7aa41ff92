"""Radii of a map's answers: the quantile, and frames from elsewhere beside the training frames left out."""

from __future__ import annotations

import numpy as np
import pytest

from lightning_pose.mapping import calibration
from lightning_pose.mapping.build_map import build_point_map, map_frames
from lightning_pose.mapping.calibration import (
    MIN_ANSWERS,
    Measured,
    calibrate_map,
    choose_map,
    find_conformal_factor,
)
from tests.mapping.helpers import make_frames, make_walk


def make_errors(count: int, ratio: float) -> Measured:
    """Errors of accepted answers, each so many times its standard deviation."""
    one = np.ones(count)
    return Measured(ratio * one, ratio * one, np.ones(count, bool), one, one, 99 * one)


def test_the_factor_is_the_quantile_with_one_deviation_of_its_rank() -> None:
    # Of 100 values, 101 * 0.9 + sqrt(100 * 0.9 * 0.1) = 93.9: the 94th.
    assert find_conformal_factor(np.random.default_rng(0).permutation(np.arange(1.0, 101))) == 94


def test_few_errors_have_the_largest_or_no_factor() -> None:
    assert find_conformal_factor(np.arange(1.0, MIN_ANSWERS + 1)) == MIN_ANSWERS
    assert np.isnan(find_conformal_factor(np.arange(MIN_ANSWERS - 1.0)))


@pytest.mark.parametrize(("ratio", "larger"), [(0.0, False), (1e3, True)])
def test_errors_of_other_frames_count_beside_those_left_out(ratio: float, larger: bool) -> None:
    mapped = map_frames(make_frames(*make_walk(60)), adjust=False)
    alone, both = calibrate_map(mapped), calibrate_map(mapped, make_errors(60, ratio))
    assert (both.position_factor > alone.position_factor) == larger
    assert (both.position_error > alone.position_error) == larger


def test_the_map_that_locates_frames_best_is_chosen_and_locates_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "MOST_CHOOSING", 5)
    training, others = make_frames(*make_walk(60)), make_frames(*make_walk(17, seed=3), seed=3)
    noise = np.random.default_rng(0).normal(0, 0.03, (60, 3))
    wrong = training.with_poses(training.rotation, training.position + noise)
    maps = [build_point_map(frames) for frames in (wrong, training)]
    best, answers = choose_map(maps, others)
    assert best == 1
    np.testing.assert_allclose([answer.pose.position for answer in answers], others.position, atol=0.02)
