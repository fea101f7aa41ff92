"""The verbs on a tiny scene: what they print and leave behind, how a run is stopped, and how it goes on."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from lightning_pose.cli import PoseCLI
from lightning_pose.data import ImageDataModule
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import stack_poses
from lightning_pose.sweeps.base_config import resolve_config
from tests.helpers import Trained, Workplace

DEAD_PROCESS = 2**22 + 1  # beyond the largest number that Linux gives
FULL_BATCH = ["--data.batch_size", "100"]  # the order of frames is then no matter of chance
BASELINES = ["train_mean", "retrieval_top1", "retrieval_top5", "oracle"]


def weights(checkpoint: Path) -> dict[str, torch.Tensor]:
    return torch.load(checkpoint, weights_only=True)["state_dict"]


def steps_logged(workplace: Workplace, run_id: str) -> list[int]:
    return [metric.step for metric in workplace.client.get_metric_history(run_id, "train/loss")]


def test_fit_prints_the_model_beside_its_baselines(trained: Trained) -> None:
    for system in ["SurfLSTM", *BASELINES]:
        assert system in trained.stdout
    assert "skill position" in trained.stdout
    assert f"run {trained.run.info.run_id} in {trained.workplace.uri}" in trained.stdout


def test_fit_writes_where_it_is_told(trained: Trained) -> None:
    assert {path.name for path in trained.workplace.folder.iterdir()} == {"mlruns", "tiny.yaml"}
    assert trained.best.is_file()
    assert trained.last.is_file()


def test_the_best_checkpoint_is_that_of_the_lowest_validation_loss(workplace: Workplace) -> None:
    assert workplace.run("fit", "--trainer.max_epochs", "3", "--model.learning_rate", "1") == 0
    (run,) = workplace.runs()
    losses = [metric.value for metric in workplace.client.get_metric_history(run.info.run_id, "val/loss")]
    best = torch.load(workplace.checkpoint(run, "best"), weights_only=True)
    assert best["epoch"] == int(np.argmin(losses))


def test_fit_without_validation_frames(workplace: Workplace) -> None:
    assert workplace.run("fit", "--data.val_fraction", "0") == 0
    (run,) = workplace.runs()
    assert run.info.status == "FINISHED"
    assert not any(name.startswith("val/") for name in run.data.metrics)
    best, last = (weights(workplace.checkpoint(run, name)) for name in ("best", "last"))
    assert all(torch.equal(best[name], last[name]) for name in last)


def test_fit_without_a_logger(workplace: Workplace, capsys: pytest.CaptureFixture[str]) -> None:
    assert workplace.run("fit", "--trainer.logger", "false") == 0
    assert "retrieval_top1" in capsys.readouterr().out
    assert workplace.runs() == []
    assert (workplace.folder / "mlruns" / "checkpoints" / "local" / "best.ckpt").is_file()


@pytest.mark.parametrize("option", [("--trainer.max_epochs", "0"), ("--trainer.fast_dev_run", "true")])
def test_fit_that_leaves_no_checkpoint_still_ends_in_the_table(
    option: tuple[str, str], workplace: Workplace, capsys: pytest.CaptureFixture[str]
) -> None:
    assert workplace.run("fit", *option) == 0
    assert "oracle" in capsys.readouterr().out


def test_fit_goes_on_with_the_last_run(workplace: Workplace, tmp_path: Path) -> None:
    assert workplace.run("fit", *FULL_BATCH) == 0
    (run,) = workplace.runs()
    workplace.client.set_tag(run.info.run_id, "process.id", str(DEAD_PROCESS))
    assert workplace.run("fit", *FULL_BATCH, "--ckpt_path", "last", "--trainer.max_epochs", "4") == 0
    (resumed,) = workplace.runs()
    assert resumed.info.run_id == run.info.run_id
    assert (resumed.info.status, resumed.info.run_name) == ("FINISHED", run.info.run_name)
    assert steps_logged(workplace, run.info.run_id) == [0, 1, 2, 3]
    assert resumed.data.tags["process.id"] == str(os.getpid()), "another run would take it for dead"
    assert resumed.data.metrics["cost/train_seconds"] > run.data.metrics["cost/train_seconds"]
    uninterrupted = Workplace.make(tmp_path / "uninterrupted", workplace.scene, workplace.folder / "mlruns/mlflow.db")
    assert uninterrupted.run("fit", *FULL_BATCH, "--trainer.max_epochs", "4") == 0
    expected = weights(uninterrupted.checkpoint(uninterrupted.runs()[0], "last"))
    for name, value in weights(workplace.checkpoint(run, "last")).items():
        torch.testing.assert_close(value, expected[name], atol=1e-4, rtol=1e-3)


def test_fit_goes_on_from_a_named_checkpoint_in_a_run_of_its_own(workplace: Workplace, trained: Trained) -> None:
    assert workplace.run("fit", "--ckpt_path", trained.last, "--trainer.max_epochs", "3") == 0
    (run,) = workplace.runs()
    assert run.info.run_id != trained.run.info.run_id
    assert len(steps_logged(workplace, run.info.run_id)) == 1
    assert torch.load(workplace.checkpoint(run, "last"), weights_only=True)["epoch"] == 2


def test_an_error_marks_the_run_failed(workplace: Workplace) -> None:
    failing = ["--trainer.callbacks+", "tests.helpers.FailAt", "--trainer.callbacks.epoch", "1"]
    with pytest.raises(RuntimeError, match="a mistake in the program"):  # with its traceback, exit code 1
        workplace.run("fit", *failing)
    assert workplace.runs()[0].info.status == "FAILED"


@pytest.mark.parametrize(("callback", "code"), [("InterruptAt", 130), ("TerminateAt", 143)])
def test_a_stopped_run_is_killed_and_goes_on(callback: str, code: int, workplace: Workplace) -> None:
    stopping = ["--trainer.callbacks+", f"tests.helpers.{callback}", "--trainer.callbacks.epoch", "1"]
    before = signal.getsignal(signal.SIGINT)
    try:
        assert workplace.run("fit", *stopping) == code
    finally:
        signal.signal(signal.SIGINT, before)  # Lightning ignores Ctrl-C while it tears a run down
    (run,) = workplace.runs()
    assert run.info.status == "KILLED"
    assert workplace.run("fit", "--ckpt_path", "last") == 0
    (run,) = workplace.runs()
    assert run.info.status == "FINISHED"
    assert {"train/loss", "test/position_median_m"} <= run.data.metrics.keys()


def test_a_killed_process(workplace: Workplace) -> None:
    """SIGINT ends in order, SIGKILL leaves a run that the next one closes."""
    endless = ["fit", "--config", workplace.config, "--trainer.max_epochs", "100000"]
    outcome = {}
    for number in (signal.SIGKILL, signal.SIGINT):
        process = workplace.fork(*endless)
        try:
            seen = len(list(workplace.folder.glob("mlruns/checkpoints/*/last.ckpt")))
            deadline = time.monotonic() + 200
            while len(list(workplace.folder.glob("mlruns/checkpoints/*/last.ckpt"))) == seen:
                assert process.poll() is None, process.communicate()
                assert time.monotonic() < deadline, "no checkpoint yet"
                time.sleep(0.1)
            process.send_signal(number)
            _, stderr = process.communicate(timeout=200)
        finally:
            process.kill()
        outcome[number] = (process.returncode, stderr, [run.info.status for run in workplace.runs()])
    assert outcome[signal.SIGKILL][0] == -signal.SIGKILL
    assert outcome[signal.SIGKILL][2] == ["RUNNING"]
    code, stderr, statuses = outcome[signal.SIGINT]
    assert code == 130
    assert stderr.splitlines()[-1] == "interrupted; `fit --ckpt_path last`, with the same settings, goes on"
    assert "Traceback" not in stderr
    assert statuses == ["KILLED", "KILLED"]


def test_test_needs_only_the_checkpoint(
    workplace: Workplace, trained: Trained, capsys: pytest.CaptureFixture[str]
) -> None:
    assert workplace.command("test", "--ckpt_path", trained.best) == 0
    output = capsys.readouterr().out
    assert "oracle" in output
    assert "Test metric" not in output, "one table, ours"
    (run,) = workplace.runs()
    assert (run.info.status, run.info.run_name) == ("FINISHED", "SurfLSTM wall N=6 (test)")
    for name, value in trained.run.data.metrics.items():
        if name.startswith(("test/", "baseline/")):
            assert run.data.metrics[name] == pytest.approx(value, rel=1e-4), name


def test_test_takes_other_data(workplace: Workplace, trained: Trained, tmp_path: Path) -> None:
    moved = tmp_path / "another"
    moved.symlink_to(workplace.scene, target_is_directory=True)
    assert workplace.command("test", "--ckpt_path", trained.best, "--data.root", moved) == 0
    assert workplace.runs()[0].data.params["data.root"] == str(moved)


def test_test_with_a_config_keeps_the_checkpoint_s_widths(workplace: Workplace, trained: Trained) -> None:
    file = workplace.folder / "wider.yaml"
    file.write_text(workplace.config.read_text().replace("units: 8", "units: 9"))
    assert workplace.command("test", "--config", file, "--ckpt_path", trained.best) == 0
    assert workplace.runs()[0].data.params["model.units"] == "8"


def test_validate(workplace: Workplace, trained: Trained, capsys: pytest.CaptureFixture[str]) -> None:
    assert workplace.command("validate", "--ckpt_path", trained.last) == 0
    assert "val/position_median_m" in capsys.readouterr().out
    assert workplace.runs() == []


def test_predict_writes_what_the_model_says(
    workplace: Workplace, trained: Trained, capsys: pytest.CaptureFixture[str]
) -> None:
    assert workplace.command("predict", "--ckpt_path", trained.best) == 0
    (line,) = capsys.readouterr().out.splitlines()
    rows = np.loadtxt(workplace.folder / line)
    images = sorted((workplace.scene / "seq-03").glob("*.png"))
    position_m, quat_wxyz = stack_poses(Localizer.load(trained.best, allow="tests").localize(images))
    np.testing.assert_array_equal(rows[:, 0], np.arange(10))
    np.testing.assert_allclose(rows[:, 1:4], position_m, atol=1e-5)
    np.testing.assert_allclose(rows[:, [7, 4, 5, 6]], quat_wxyz, atol=1e-5)
    assert workplace.runs() == []


def test_results_go_where_the_environment_says(workplace: Workplace, tmp_path: Path) -> None:
    elsewhere = Workplace.make(tmp_path / "elsewhere", workplace.scene, workplace.folder / "mlruns/mlflow.db")
    assert workplace.run("fit", "--trainer.logger.tracking_uri", elsewhere.uri) == 0
    assert workplace.runs() == []
    assert len(elsewhere.runs()) == 1


@pytest.mark.parametrize("verb", ["fit", "test", "validate", "predict"])
def test_help(verb: str, workplace: Workplace, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        workplace.command(verb, "--help")
    assert stop.value.code == 0
    assert "--ckpt_path" in capsys.readouterr().out


@pytest.fixture
def older_config(workplace: Workplace) -> Path:
    """A config as version 0.1 wrote it: classes by the modules that they were in."""
    config = yaml.safe_load(workplace.config.read_text())
    config["model"]["class_path"] = "lightning_pose.models.surf_lstm.SurfLSTM"
    config["data"]["class_path"] = "lightning_pose.data.datamodules.ImageDataModule"
    config["data"]["init_args"]["extractor"] = {
        "class_path": "lightning_pose.features.classical.SIFT",
        "init_args": {"n_features": 8},
    }
    config["trainer"]["logger"] = {"class_path": "lightning_pose.tracking.MLflowLogger"}
    file = workplace.folder / "older.yaml"
    file.write_text(yaml.safe_dump(config))
    return file


def test_an_older_config_trains(workplace: Workplace, older_config: Path) -> None:
    assert workplace.command("fit", "--config", older_config) == 0
    assert workplace.runs()[0].info.status == "FINISHED"


@pytest.mark.parametrize("joint", [" ", "="])
def test_older_class_paths_on_the_command_line(workplace: Workplace, joint: str) -> None:
    words = [
        "--data=lightning_pose.data.datamodules.ImageDataModule".replace("=", joint),
        "--data.extractor=lightning_pose.features.classical.ORB".replace("=", joint),
    ]
    cli = PoseCLI(["--config", str(workplace.config), *" ".join(words).split()], run=False)
    assert type(cli.datamodule) is ImageDataModule
    assert cli.config.data.init_args.extractor.class_path == "lightning_pose.features.ORB"


def test_a_sweep_reads_an_older_base_config(older_config: Path) -> None:
    _, _, config = resolve_config(older_config, {"model.units": 4})
    assert config["data"]["class_path"] == "lightning_pose.data.ImageDataModule"
    assert config["data"]["init_args"]["extractor"]["class_path"] == "lightning_pose.features.SIFT"
    assert config["model"]["class_path"] == "lightning_pose.models.SurfLSTM"
