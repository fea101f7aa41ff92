"""Training that explodes ends in one line and a failed run, and leaves no checkpoint of weights that are no numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from lightning_pose.features.base import Record
from tests.helpers import Thumbnails, Trained, Workplace


class NotNumbers(Thumbnails):
    """Thumbnails as vectors, some of which are not numbers."""

    @property
    def feature_shape(self) -> tuple[int, ...]:
        return (self.rows * self.columns,)

    def extract(self, images: Sequence[np.ndarray]) -> list[Record]:
        records = [{"thumbnail": record["thumbnail"].flatten()} for record in super().extract(images)]
        records[0]["thumbnail"][0] = float("nan")
        return records


def is_finite(checkpoint: Path) -> bool:
    return all(value.isfinite().all() for value in torch.load(checkpoint, weights_only=True)["state_dict"].values())


@pytest.mark.parametrize("options", [["--model.learning_rate", "1e6"], ["--model.learning_rate", "1e30"]])
@pytest.mark.parametrize("val_fraction", ["0.1", "0"])
def test_a_learning_rate_out_of_all_bounds(
    options: list[str], val_fraction: str, workplace: Workplace, capsys: pytest.CaptureFixture[str]
) -> None:
    assert workplace.run("fit", *options, "--data.val_fraction", val_fraction, "--trainer.max_epochs", "5") == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "diverged" in line or "not finite" in line
    assert "model.learning_rate" in line
    (run,) = workplace.runs()
    assert run.info.status == "FAILED"
    assert all(is_finite(file) for file in workplace.folder.glob("mlruns/checkpoints/*/*.ckpt"))


@pytest.mark.parametrize("architecture", ["DensePoseNet", "KernelPoseNet", "LinearPoseNet"])
def test_features_that_are_no_numbers(
    architecture: str, workplace: Workplace, capsys: pytest.CaptureFixture[str]
) -> None:
    model = f"lightning_pose.models.{architecture}"
    bad = ["--data.extractor", "tests.runs.test_explosions.NotNumbers", "--model", model]
    assert workplace.run("fit", *bad) == 2
    assert "not finite numbers" in capsys.readouterr().err.splitlines()[-1]
    assert all(run.info.status == "FAILED" for run in workplace.runs())


def test_poses_that_are_no_numbers_are_not_written(
    workplace: Workplace, trained: Trained, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoint = torch.load(trained.best, weights_only=True)
    next(iter(checkpoint["state_dict"].values())).fill_(float("nan"))
    torch.save(checkpoint, tmp_path / "broken.ckpt")
    for verb in ("predict", "test", "validate"):
        assert workplace.command(verb, "--ckpt_path", tmp_path / "broken.ckpt") == 2
        assert "not finite numbers" in capsys.readouterr().err.splitlines()[-1]
    assert not list(workplace.folder.rglob("*.tum"))
    assert [run.info.status for run in workplace.runs()] == ["FAILED"]
