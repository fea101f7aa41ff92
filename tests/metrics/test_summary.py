"""The summary of errors: medians, percentiles, recalls, and what diverged predictions do to them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from lightning_pose.errors import ConfigError
from lightning_pose.metrics.catalog import ERRORS
from lightning_pose.metrics.summary import summarize_errors


def test_known_values() -> None:
    position = torch.tensor([0.01, 0.05, 0.10, 4.0], dtype=torch.float64)
    orientation = torch.tensor([1.0, 4.0, 5.0, 9.0], dtype=torch.float64)
    summary = summarize_errors(position, orientation)
    assert summary["position_median_m"] == pytest.approx(0.075)
    assert summary["orientation_median_deg"] == pytest.approx(4.5)
    assert summary["position_mean_m"] == pytest.approx(1.04)
    assert summary["orientation_mean_deg"] == pytest.approx(4.75)
    assert summary["position_p95_m"] == pytest.approx(np.quantile(position, 0.95))
    assert summary["orientation_p95_deg"] == pytest.approx(np.quantile(orientation, 0.95))
    recalls = {name: summary[name] for name in ERRORS if name.startswith("recall")}
    assert recalls == {
        "recall_1cm_1deg": 0.25,
        "recall_2cm_2deg": 0.25,
        "recall_5cm_5deg": 0.5,
        "recall_10cm_5deg": 0.75,
        "recall_25cm_2deg": 0.25,
        "recall_50cm_5deg": 0.75,
        "recall_5m_10deg": 1.0,
    }


def test_median_of_an_odd_count_and_of_one() -> None:
    assert summarize_errors(np.array([3.0, 1.0, 2.0]), np.ones(3))["position_median_m"] == 2
    assert summarize_errors(np.array([7.0]), np.ones(1))["position_p95_m"] == 7


def test_nan_counts_as_infinite() -> None:
    summary = summarize_errors(np.array([0.0, 0.0, np.nan]), np.array([0.0, np.nan, 0.0]))
    assert summary["position_median_m"] == 0
    assert math.isinf(summary["position_mean_m"])
    assert math.isinf(summary["position_p95_m"])
    assert summary["recall_5m_10deg"] == pytest.approx(1 / 3)


def test_all_infinite_stays_infinite() -> None:
    summary = summarize_errors(np.full(4, np.nan), np.full(4, np.nan))
    assert math.isinf(summary["position_median_m"])
    assert summary["recall_5m_10deg"] == 0


@pytest.mark.parametrize(("n_position", "n_orientation"), [(0, 0), (3, 2)])
def test_empty_or_unequal_is_refused(n_position: int, n_orientation: int) -> None:
    with pytest.raises(ConfigError, match=rf"{n_position} position .* {n_orientation} orientation .*; give"):
        summarize_errors(torch.zeros(n_position), torch.zeros(n_orientation))
