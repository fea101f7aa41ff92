"""EpochMeans: the training loss of an epoch, over all items and over what an epoch that ends early has seen."""

from __future__ import annotations

import pytest
import torch

from lightning_pose.models.parts.epoch_means import EpochMeans
from tests.helpers import Workplace


def test_a_mean_over_items() -> None:
    means = EpochMeans()
    assert means.take() == {}
    for loss, count in ((1.0, 8), (4.0, 2)):
        means.add({"total": torch.tensor(loss, requires_grad=True), "half": torch.tensor(loss).half()}, count)
    found = means.take()
    assert {name: float(value) for name, value in found.items()} == {
        "total": pytest.approx(1.6),
        "half": pytest.approx(1.6),
    }
    assert found["half"].dtype == torch.float32
    assert not found["total"].requires_grad
    assert means.take() == {}


def test_an_epoch_that_ends_early_has_a_loss(workplace: Workplace) -> None:
    assert workplace.run("fit", "--trainer.max_steps", 4) == 0
    (run,) = workplace.runs()
    history = workplace.client.get_metric_history(run.info.run_id, "train/loss")
    assert [metric.step for metric in history] == [2, 3]
