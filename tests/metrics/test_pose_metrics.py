"""PoseMetrics: batches add up, half precision and diverged predictions are handled."""

from __future__ import annotations

import math

import pytest
import torch

from lightning_pose.errors import ConfigError
from lightning_pose.metrics.pose_metrics import PoseMetrics, summarize_errors

IDENTITY = torch.tensor([1.0, 0.0, 0.0, 0.0])


def poses(n: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(n, 3, generator=generator), torch.randn(n, 4, generator=generator)


def test_known_errors() -> None:
    metrics = PoseMetrics()
    truth = torch.zeros(2, 3)
    position_hat = torch.tensor([[0.03, 0.0, 0.0], [0.0, 0.0, 1.0]])
    half = math.radians(10) / 2
    quat_hat = torch.stack([-2 * IDENTITY, torch.tensor([math.cos(half), 0.0, math.sin(half), 0.0])])
    metrics.update(position_hat, quat_hat, truth, IDENTITY.expand(2, 4))
    result = metrics.compute()
    assert result["position_median_m"] == pytest.approx(0.515)
    assert result["orientation_median_deg"] == pytest.approx(5, abs=1e-4)
    assert result["recall_5cm_5deg"] == 0.5


def test_batches_clips_and_one_go_agree() -> None:
    (p_hat, q_hat), (p, q) = poses(12), poses(12, seed=1)
    whole, batched, clips = PoseMetrics(), PoseMetrics(), PoseMetrics()
    whole.update(p_hat, q_hat, p, q)
    for part in (slice(0, 5), slice(5, 6), slice(6, 12)):
        batched.update(p_hat[part], q_hat[part], p[part], q[part])
    clips.update(*(x.unflatten(0, (3, 4)) for x in (p_hat, q_hat, p, q)))
    assert whole.compute() == batched.compute() == clips.compute()


def test_gathered_state_is_a_tensor() -> None:
    alone, gathered = PoseMetrics(), PoseMetrics()
    gathered.dist_sync_fn = lambda state, group: [state]  # all that one process gathers
    gathered.distributed_available_fn = lambda: True
    for metrics in (alone, gathered):
        metrics.update(*poses(4), *poses(4, seed=1))
        metrics.update(*poses(3, seed=2), *poses(3, seed=3))
    assert gathered.compute() == alone.compute()


def test_half_precision_predictions_keep_the_truth_exact() -> None:
    metrics = PoseMetrics()
    truth = torch.tensor([[100.03, 0.0, 0.0]])
    metrics.update(torch.tensor([[100.0, 0.0, 0.0]]).half(), IDENTITY[None].half(), truth, IDENTITY[None])
    assert metrics.compute()["position_median_m"] == pytest.approx(0.03, abs=1e-4)


def test_nan_predictions_count_as_infinite() -> None:
    metrics = PoseMetrics()
    nan = float("nan")
    metrics.update(torch.full((1, 3), nan), torch.full((1, 4), nan), torch.zeros(1, 3), IDENTITY[None])
    result = metrics.compute()
    assert math.isinf(result["position_median_m"])
    assert math.isinf(result["orientation_median_deg"])
    assert result["recall_5m_10deg"] == 0


def test_reset_forgets() -> None:
    metrics = PoseMetrics()
    metrics.update(*poses(4), *poses(4, seed=1))
    metrics.reset()
    metrics.update(torch.zeros(1, 3), IDENTITY[None], torch.zeros(1, 3), IDENTITY[None])
    assert metrics.compute() == summarize_errors(torch.zeros(1), torch.zeros(1))


@pytest.mark.filterwarnings("ignore:The ``compute`` method")
def test_empty_is_refused() -> None:
    with pytest.raises(ConfigError, match="0 position errors"):
        PoseMetrics().compute()
