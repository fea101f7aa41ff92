"""Callbacks: where checkpoints go, and what the recorder writes of a run."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
import yaml
from lightning import Trainer

from lightning_pose.data import ImageDataModule
from lightning_pose.models import SurfLSTM
from lightning_pose.runs.checkpoints import BestCheckpoint, LastCheckpoint, checkpoint_folder
from lightning_pose.runs.clock import read_train_seconds
from lightning_pose.runs.logger import MLflowLogger
from lightning_pose.runs.recorder import RunRecorder
from tests.helpers import REPOSITORY, Thumbnails, Trained, Workplace


def test_checkpoints_of_no_run_are_local(tmp_path: Path) -> None:
    trainer = Trainer(default_root_dir=tmp_path, logger=False, accelerator="cpu", enable_progress_bar=False)
    assert checkpoint_folder(trainer) == tmp_path / "checkpoints" / "local"
    assert read_train_seconds(trainer) is None


def test_tags_and_parameters(trained: Trained) -> None:
    tags, params = trained.run.data.tags, trained.run.data.params
    expected = {
        "architecture": "SurfLSTM",
        "dataset": "7scenes",
        "scene": "wall",
        "split": "official",
        "ground_truth": "original",
        "unit": "m",
        "features": "thumbnails",
        "task": "absolute",
        "test_frames": "10",
        "image_size": "64x48",
        "verb": "fit",
        "mlflow.runName": "SurfLSTM wall N=6",
    }
    assert expected.items() <= tags.items()
    assert not {"clip_length", "stride", "relative_frame"} & tags.keys()
    assert params["model.units"] == "8"
    assert params["model.loss.form"] == "joint"
    assert params["data.extractor.class_path"] == "tests.helpers.Thumbnails"
    assert params["data.root"] == str(trained.workplace.scene)
    assert (params["trainer.max_epochs"], params["seed"]) == ("2", "0")
    assert (params["architecture"], params["scene"], params["features"]) == ("SurfLSTM", "wall", "thumbnails")
    assert not {"data.workers", "data.cache_dir"} & params.keys(), "they change no result"


@pytest.mark.skipif(not (REPOSITORY / ".git").exists() or not shutil.which("git"), reason="no git checkout")
def test_the_commit_is_that_of_the_current_folder(trained: Trained) -> None:
    assert "git_commit" not in trained.run.data.tags, "the workplace is no checkout"


def test_the_config_of_a_run_repeats_it(trained: Trained, workplace: Workplace) -> None:
    file = trained.workplace.client.download_artifacts(trained.run.info.run_id, "config.yaml")
    config = yaml.safe_load(Path(file).read_text())
    assert config["model"]["init_args"]["units"] == 8
    assert config["seed_everything"] == 0
    assert workplace.command("fit", "--config", file) == 0
    (run,) = workplace.runs()
    repeated, before = (torch.load(f, weights_only=True) for f in (workplace.checkpoint(run, "last"), trained.last))
    for name, weights in before["state_dict"].items():
        assert torch.equal(repeated["state_dict"][name], weights), name


def test_last_has_all_that_training_needs_and_best_the_weights(trained: Trained) -> None:
    last, best = (torch.load(file, weights_only=True) for file in (trained.last, trained.best))
    assert {"optimizer_states", "loops", "callbacks"} <= last.keys()
    assert "optimizer_states" not in best
    assert best["state_dict"].keys() == last["state_dict"].keys()
    assert best["lightning_pose"] == last["lightning_pose"]
    assert trained.best.stat().st_size < trained.last.stat().st_size


def test_the_run_tells_the_validation_metrics_of_its_best_epoch(workplace: Workplace) -> None:
    assert workplace.run("fit", "--trainer.max_epochs", "4", "--model.learning_rate", "0.3") == 0
    (run,) = workplace.runs()

    def history(name: str) -> list[float]:
        return [metric.value for metric in workplace.client.get_metric_history(run.info.run_id, name)]

    losses = history("val/loss")
    best = losses.index(min(losses))
    assert run.data.metrics["best/val/loss"] == losses[best]
    assert run.data.metrics["best/val/position_median_m"] == history("val/position_median_m")[best]


def test_the_parts_work_without_the_command_line(workplace: Workplace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(workplace.folder)
    data = ImageDataModule(Thumbnails(), root=str(workplace.scene), batch_size=8)
    logger = MLflowLogger(tracking_uri=workplace.uri, run_name="by hand")
    trainer = Trainer(
        default_root_dir="mlruns",
        max_epochs=1,
        accelerator="cpu",
        logger=logger,
        callbacks=[RunRecorder(), BestCheckpoint(monitor="val/position_median_m"), LastCheckpoint()],
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(SurfLSTM(input_shape=list(data.input_shape), units=4), datamodule=data)
    (run,) = workplace.runs()
    assert (run.info.run_name, run.info.status) == ("by hand", "FINISHED")
    assert {path.name for path in checkpoint_folder(trainer).iterdir()} == {"best.ckpt", "last.ckpt"}
    kept = {Path(file.path).name for file in workplace.client.list_artifacts(run.info.run_id)}
    assert kept == {"checkpoints"}
