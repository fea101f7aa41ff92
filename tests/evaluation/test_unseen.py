"""`validate` measures frames that a model has not learnt from, or says that there are none."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from lightning_pose.features.base import Record
from tests.helpers import Thumbnails, Trained, Workplace


class Vectors(Thumbnails):
    """Thumbnails as vectors."""

    @property
    def feature_shape(self) -> tuple[int, ...]:
        return (self.rows * self.columns,)

    def features(self, record: Record) -> np.ndarray:
        return record["thumbnail"].flatten()


LINEAR = ["--model", "lightning_pose.models.LinearPoseNet", "--data.extractor", "tests.evaluation.test_unseen.Vectors"]


def train(workplace: Workplace, *options: str) -> tuple[Path, dict[str, float]]:
    assert workplace.run("fit", *LINEAR, *options) == 0
    run = workplace.runs()[0]
    return workplace.checkpoint(run, "best"), run.data.metrics


def read_metric(output: str, name: str) -> float:
    found = re.search(rf"{name}\W+([\d.]+)", output)
    assert found is not None, output
    return float(found.group(1))


def test_a_refit_model_has_learnt_from_all(workplace: Workplace, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint, _ = train(workplace)
    assert workplace.command("validate", "--ckpt_path", checkpoint, allow=["tests"]) == 2
    assert re.search("has learnt from all . validation frames.*refit false", capsys.readouterr().err)
    older = torch.load(checkpoint, weights_only=True)
    del older["learnt_frames"]
    torch.save(older, checkpoint)
    assert workplace.command("validate", "--ckpt_path", checkpoint, allow=["tests"]) == 2


def test_without_refit_the_run_s_own_metrics_are_found_again(
    workplace: Workplace, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint, metrics = train(workplace, "--model.refit", "false")
    assert workplace.command("validate", "--ckpt_path", checkpoint, allow=["tests"]) == 0
    found = read_metric(capsys.readouterr().out, "val/position_median_m")
    assert found == pytest.approx(metrics["val/position_median_m"], rel=1e-4)


def test_training_frames_that_another_fraction_puts_into_validation(
    workplace: Workplace, trained: Trained, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        workplace.command("validate", "--ckpt_path", trained.best, "--data.val_fraction", "0.5", allow=["tests"]) == 0
    )
    output = capsys.readouterr().out
    (left_out,) = re.findall(r"(\d+) validation frames are left out", output)
    assert int(left_out) > 0
    assert read_metric(output, "val/position_median_m") > 0
