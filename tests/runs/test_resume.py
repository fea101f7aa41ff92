"""A run that goes on is the run that was not stopped, with the settings that it began with."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
import torch
from lightning import Trainer
from mlflow.entities import Run

from lightning_pose.checkpoint import read_checkpoint
from lightning_pose.runs.resume import check_same_settings
from tests.helpers import FailAt, Workplace

LIVELY = ["--trainer.max_epochs", "5", "--model.dropout", "0.3", "--model.layers", "2"]
"""Shuffled batches and dropout: each epoch draws random numbers."""


class FailInTest(FailAt):
    """Breaks in the test that follows training."""

    def on_train_batch_end(self, trainer: Trainer, *args: object, **kwargs: object) -> None:
        """Training goes well."""

    def on_test_start(self, trainer: Trainer, *args: object, **kwargs: object) -> None:
        self.stop()


def stop_at(callback: str, epoch: int) -> list[str]:
    return ["--trainer.callbacks+", callback, "--trainer.callbacks.epoch", str(epoch)]


def stop_run(workplace: Workplace, *args: str) -> Run:
    with contextlib.suppress(RuntimeError):
        workplace.run("fit", *args)
    (run,) = workplace.runs()
    assert run.info.status == "FAILED"
    return run


def read_weights(workplace: Workplace) -> dict[str, torch.Tensor]:
    (run,) = workplace.runs()
    return torch.load(workplace.checkpoint(run, "last"), weights_only=True)["state_dict"]


@pytest.mark.parametrize("schedule", ["constant", "cosine"])
def test_a_resumed_run_is_the_uninterrupted_one(
    schedule: str, workplace: Workplace, store: Path, tmp_path: Path
) -> None:
    settings = [*LIVELY, "--model.schedule", schedule]
    stop_run(workplace, *settings, *stop_at("tests.helpers.FailAt", 3))
    assert workplace.run("fit", *settings, "--ckpt_path", "last") == 0
    whole = Workplace.make(tmp_path / "whole", workplace.scene, store)
    assert whole.run("fit", *settings) == 0
    expected = read_weights(whole)
    assert all(torch.equal(value, expected[name]) for name, value in read_weights(workplace).items())
    (resumed,), (run,) = workplace.runs(), whole.runs()
    for name, value in run.data.metrics.items():
        if not name.startswith("cost/"):
            assert resumed.data.metrics[name] == pytest.approx(value, rel=1e-6), name


def test_the_best_epoch_before_the_stop_is_kept(workplace: Workplace) -> None:
    # So high a rate makes a later epoch worse than an early one.
    settings = ["--trainer.max_epochs", "4", "--model.learning_rate", "1"]
    run = stop_run(workplace, *settings, *stop_at("tests.helpers.FailAt", 3))
    assert workplace.run("fit", *settings, "--ckpt_path", "last") == 0
    losses = [metric.value for metric in workplace.client.get_metric_history(run.info.run_id, "val/loss")]
    assert len(losses) == 4
    assert workplace.runs()[0].data.metrics["best/val/loss"] == pytest.approx(min(losses))


def test_a_run_goes_on_from_an_older_checkpoint_and_logs_no_epoch_twice(workplace: Workplace) -> None:
    # As after `kill -9` within epochs that are shorter than a write.
    settings = ["--trainer.max_epochs", "5"]
    run = stop_run(workplace, *settings, *stop_at("tests.helpers.FailAt", 2))
    older = workplace.checkpoint(run, "last").read_bytes()
    with contextlib.suppress(RuntimeError):
        workplace.run("fit", *settings, "--ckpt_path", "last", *stop_at("tests.helpers.FailAt", 4))
    workplace.checkpoint(run, "last").write_bytes(older)
    assert workplace.run("fit", *settings, "--ckpt_path", "last") == 0
    for name in ("train/loss", "val/loss"):
        history = workplace.client.get_metric_history(run.info.run_id, name)
        assert len({metric.step for metric in history}) == len(history) == 5


@pytest.mark.parametrize("early", [False, True])
def test_a_run_stopped_after_its_last_epoch_goes_on_to_its_test(early: bool, workplace: Workplace) -> None:
    settings = ["--trainer.max_epochs", "2"]
    if early:
        stopping = ["--trainer.callbacks+", "lightning.pytorch.callbacks.EarlyStopping"]
        limits = {"monitor": "val/loss", "patience": "0", "min_delta": "1000"}
        settings = ["--trainer.max_epochs", "50", *stopping]
        settings += [word for name, value in limits.items() for word in (f"--trainer.callbacks.{name}", value)]
    run = stop_run(workplace, *settings, *stop_at("tests.runs.test_resume.FailInTest", 0))
    before = read_weights(workplace)
    assert "test/position_median_m" not in run.data.metrics
    assert workplace.run("fit", *settings, "--ckpt_path", "last") == 0
    (finished,) = workplace.runs()
    assert finished.info.status == "FINISHED"
    assert {"test/position_median_m", "best/val/loss", "cost/train_seconds"} <= finished.data.metrics.keys()
    assert len(workplace.client.get_metric_history(run.info.run_id, "train/loss")) == 2
    assert all(torch.equal(value, before[name]) for name, value in read_weights(workplace).items())


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory, scene: Path, store: Path) -> Workplace:
    """A run that was stopped in its second epoch; a refusal leaves it as it is."""
    workplace = Workplace.make(tmp_path_factory.mktemp("stopped") / "workplace", scene, store)
    stop_run(workplace, *stop_at("tests.helpers.FailAt", 1))
    return workplace


@pytest.mark.parametrize(
    ("option", "says"),
    [
        (["--model.learning_rate", "0.0001"], "model.learning_rate is 0.0001 and was 0.01"),
        (["--model.weight_decay", "0.5"], "model.weight_decay is 0.5 and was 0.0"),
        (["--model.standardize", "false"], "model.standardize is False and was True"),
        (["--model.loss.orientation_weight", "3"], "model.loss.orientation_weight is 3.0 and was 1.0"),
        (["--data.batch_size", "4"], "data.batch_size is 4.0 and was 8.0"),
        (["--data.val_fraction", "0.3"], "data.val_fraction is 0.3 and was 0.1"),
        (["--seed_everything", "5"], "seed_everything is 5 and was 0"),
        (["--trainer.precision", "64-true"], "trainer.precision is 64-true and was 32-true"),
    ],
)
def test_other_settings_are_refused(
    option: list[str], says: str, stopped: Workplace, capsys: pytest.CaptureFixture[str]
) -> None:
    (run,) = stopped.runs()
    assert stopped.run("fit", "--ckpt_path", "last", *option) == 2
    assert says in capsys.readouterr().err.splitlines()[-1]
    (same,) = stopped.runs()
    assert (same.info.status, same.data.params) == ("FAILED", run.data.params)


def test_settings_that_change_no_result_may_differ(workplace: Workplace) -> None:
    stop_run(workplace, *stop_at("tests.helpers.FailAt", 1))
    assert workplace.run("fit", "--ckpt_path", "last", "--data.eval_batch_size", "3") == 0
    (run,) = workplace.runs()
    assert run.info.status == "FINISHED"


def test_the_folders_of_the_data_may_have_moved(workplace: Workplace) -> None:
    assert workplace.run("fit") == 0
    (run,) = workplace.runs()
    checkpoint = str(workplace.checkpoint(run, "last"))
    specs = read_checkpoint(checkpoint)["lightning_pose"]
    places = {"root": "new", "train_scenes": None, "test_scenes": None, "val_scenes": ["new"], "pgt": "new"}
    moved = {**specs["data"], "init_args": {**specs["data"]["init_args"], **places}}
    check_same_settings(checkpoint, specs["model"], moved, 0, "32-true")


def test_more_epochs_are_recorded(workplace: Workplace) -> None:
    assert workplace.run("fit") == 0
    assert workplace.run("fit", "--ckpt_path", "last", "--trainer.max_epochs", "3") == 0
    (run,) = workplace.runs()
    assert run.data.tags["trainer.max_epochs"] == "3"


class DieUnlogged(FailAt):
    """Breaks between the epoch's checkpoint and Lightning's log of its training metrics."""

    def on_train_batch_end(self, trainer: Trainer, *args: object, **kwargs: object) -> None:
        if trainer.current_epoch == self.epoch:
            logger = next(iter(trainer.loggers))
            logger.log_metrics = lambda metrics, step=None: self.stop()  # type: ignore[method-assign]


def test_the_metrics_of_the_checkpoint_s_epoch_are_logged(workplace: Workplace) -> None:
    settings = ["--trainer.max_epochs", "3", "--data.val_fraction", "0"]
    run = stop_run(workplace, *settings, *stop_at("tests.runs.test_resume.DieUnlogged", 1))
    steps = {metric.step for metric in workplace.client.get_metric_history(run.info.run_id, "train/loss")}
    assert workplace.run("fit", *settings, "--ckpt_path", "last") == 0
    history = workplace.client.get_metric_history(run.info.run_id, "train/loss")
    assert len(steps) == 1
    assert [metric.step for metric in history] == [2, 5, 8]


CLOSED_FORM = ["--model", "lightning_pose.models.LinearPoseNet", "--model.lambdas", "[1.0]"]
CLOSED_FORM += ["--data.extractor", "tests.evaluation.test_unseen.Vectors", "--data.val_fraction", "0"]


@pytest.mark.parametrize("stop", ["tests.runs.test_resume.DieUnlogged", "tests.runs.test_resume.FailInTest"])
def test_a_resumed_closed_form_has_the_metrics_of_the_uninterrupted_one(
    stop: str, workplace: Workplace, store: Path, tmp_path: Path
) -> None:
    # It steps once in an epoch of three batches, and Lightning logs by batches.
    stop_run(workplace, *CLOSED_FORM, *stop_at(stop, 0))
    assert workplace.run("fit", *CLOSED_FORM, "--ckpt_path", "last") == 0
    whole = Workplace.make(tmp_path / "whole", workplace.scene, store)
    assert whole.run("fit", *CLOSED_FORM) == 0
    expected = read_history(whole)
    assert read_history(workplace) == expected
    assert [step for step, _ in expected["train/loss"]] == [2]  # of batches 0 to 2


def read_history(workplace: Workplace) -> dict[str, list[tuple[int, float]]]:
    """Step and value of all that the only run has logged of each metric but costs."""
    (run,) = workplace.runs()
    names = [name for name in run.data.metrics if not name.startswith("cost/")]
    histories = {name: workplace.client.get_metric_history(run.info.run_id, name) for name in names}
    return {name: [(metric.step, metric.value) for metric in history] for name, history in histories.items()}
