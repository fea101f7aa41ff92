"""One trial: a run of `fit` that reports every epoch, can be pruned, and chooses nothing by test frames."""

from __future__ import annotations

import contextlib
import io
import math
import shutil
import traceback
from collections.abc import Mapping
from typing import Any

import optuna
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from mlflow import MlflowClient
from mlflow.exceptions import MlflowException
from optuna import Trial
from optuna.exceptions import OptunaError

from lightning_pose.cli import PoseCLI
from lightning_pose.concurrency.signals import delay_interrupts
from lightning_pose.errors import ConfigError, PoseError
from lightning_pose.evaluation.callback import TestReport
from lightning_pose.evaluation.costs import costs
from lightning_pose.features.keypoint_statistics import measure_keypoints
from lightning_pose.models.parts.symmetric import shared_factors
from lightning_pose.runs.checkpoints import BestCheckpoint, checkpoint_folder, run_logger
from lightning_pose.runs.process import process_tags
from lightning_pose.runs.tags import CURVES, METRICS, PARENT_TAG, REASON, RUN
from lightning_pose.sweeps.base_config import ParsedConfig, open_keypoint_data
from lightning_pose.sweeps.plan import Plan
from lightning_pose.sweeps.space import Settings, draw_values

__all__ = ["EpochWatch", "TrialCLI", "run_trial"]


class EpochWatch(Callback):
    """Keeps the validation metrics of each epoch, and asks the pruner whether to go on.

    Args:
        plan: of the sweep.
        trial: what reports go to.

    Attributes:
        monitor: the metric whose lowest value decides which epoch's weights `fit` keeps.
        epochs: the metrics of each.
        pruned: why it was pruned, None where it was not.
    """

    def __init__(self, plan: Plan, trial: Trial) -> None:
        self.objectives = plan.objectives
        self.trial = trial
        self.monitor = "val/loss"
        self.epochs: list[dict[str, float]] = []
        self.pruned: str | None = None

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.sanity_checking:
            return
        found = trainer.callback_metrics.items()
        measured = {name: float(v) for name, v in found if name.startswith("val/") or name == self.monitor}
        self.epochs.append(measured)
        first = self.objectives[0].metric
        # Pruners compare trials by one number; Optuna refuses reports for several objectives.
        if len(self.objectives) > 1 or not math.isfinite(measured.get(first, math.nan)):
            return
        self.trial.report(measured[first], trainer.current_epoch)
        last = trainer.current_epoch + 1 == trainer.max_epochs  # pruning the last epoch would save nothing
        if not last and self.trial.should_prune():
            self.pruned = f"pruned after epoch {trainer.current_epoch + 1} with {first} {measured[first]:.4g}"
            trainer.should_stop = True

    def values(self) -> dict[str, float]:
        """The metrics of the epoch whose weights `fit` would keep, so that `fit` reproduces the trial's value.

        Raises:
            ConfigError: no validation frames, or no epoch ended in a number.
        """
        chosen = next((o for o in self.objectives if o.metric.startswith("val/")), None)
        if chosen is None:
            return {}
        if not self.epochs:
            raise ConfigError(f"{chosen.metric} was never measured; give data.val_fraction, such as 0.1")
        needed = (chosen.metric, self.monitor)
        finite = [epoch for epoch in self.epochs if all(math.isfinite(epoch.get(name, math.nan)) for name in needed)]
        if not finite:
            raise ConfigError(f"{chosen.metric} was never a finite number: training diverged; lower the learning rate")
        return min(finite, key=lambda epoch: epoch[self.monitor])


class TrialCLI(PoseCLI):
    """`fit` without a progress bar and checkpoints, and without its test unless the study measures test frames.

    Attributes:
        measured: metrics beside those of validation frames.
        curves: metrics over a whole number, such as a clip's length.
    """

    def __init__(self, args: list[str], watch: EpochWatch, plan: Plan) -> None:
        self.watch = watch
        self.plan = plan
        self.measured: dict[str, float] = {}
        self.curves: Mapping[str, Mapping[int, float]] = {}
        try:
            super().__init__(["fit", *args])
        finally:
            if plan.measure == "test" and hasattr(self, "trainer"):  # its best epoch was kept for the test
                shutil.rmtree(checkpoint_folder(self.trainer), ignore_errors=True)

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        trainer = super().instantiate_trainer(**kwargs)
        self.recorder.keeps_checkpoints = False
        best = next(c for c in trainer.checkpoint_callbacks if isinstance(c, BestCheckpoint))
        self.watch.monitor = best.monitor or self.watch.monitor
        wanted = BestCheckpoint if self.plan.measure == "test" else ()
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]  # which Lightning does not declare
        callbacks[:] = [c for c in callbacks if not isinstance(c, ModelCheckpoint) or isinstance(c, wanted)]
        callbacks.append(self.watch)
        if trainer.progress_bar_callback is not None:
            trainer.progress_bar_callback.disable()
        return trainer

    def after_fit(self) -> None:
        if self.watch.pruned is not None:
            return
        if self.plan.measure == "test":
            self._measure_test()
        else:  # test frames must not choose
            self._measure_costs()

    def _measure_test(self) -> None:
        """Measure the best epoch on the test frames, only for the study's figure and table."""
        report: TestReport = self.config_init["fit"].report
        report.log_model = False
        with contextlib.redirect_stdout(io.StringIO()):  # without the table of each trial
            super().after_fit()
        found = report.evaluation
        assert found is not None, "a test ends in an evaluation"
        own = next(iter(report.results.values()))
        self.measured = {f"test/{name}": value for name, value in own.items()} | found.extras
        for system, metrics in found.baselines.items():
            self.measured |= {f"baseline/{system}/{name}": value for name, value in metrics.items()}
        self.curves = found.curves

    def _measure_costs(self) -> None:
        """Measure the model's costs without test frames."""
        split = "val" if len(self.datamodule.scene.splits["val"]) else "train"
        frames = self.datamodule.clip_length if self.model.reads_clips else 1
        extracts = any(objective.metric == "cost/features_ms_per_frame" for objective in self.plan.objectives)
        self.measured = costs(self.trainer, self.model.eval(), frames, split, features=extracts)
        logger = run_logger(self.trainer)
        if logger is not None:
            logger.log_metrics(self.measured)


def run_trial(trial: Trial, plan: Plan, parent: str) -> list[float]:
    """Train once with the trial's values, as a nested MLflow run.

    Args:
        trial: asks for values, takes reports.
        plan: of the sweep.
        parent: MLflow run id of the study.

    Returns:
        The objectives' values.

    Raises:
        optuna.TrialPruned: the pruner stopped it.
        KeyboardInterrupt: the user did.
        Exception: what went wrong in it, which is recorded in Optuna and MLflow first.
    """
    record = _TrialRecord(trial, plan)
    try:
        run = record.create_run(parent)
        values = draw_values(trial, plan.space)
        for key, value in values.items():
            record.client.set_tag(run, f"sweep.{key}", str(value))
        if plan.measure == "features":
            return _measure_features(record, run, values)
        watch = EpochWatch(plan, trial)
        with shared_factors():
            cli = TrialCLI([*plan.arguments(values), f"--trainer.logger.run_id={run}"], watch, plan)
        if watch.pruned is not None:
            raise optuna.TrialPruned(watch.pruned)
        return record.keep_values(watch.values() | cli.measured, cli.curves)
    except optuna.TrialPruned as pruned:
        record.keep_reason("PRUNED", "KILLED", str(pruned))
        raise
    except (KeyboardInterrupt, SystemExit) as stop:  # Lightning turns Ctrl-C and SIGTERM into SystemExit
        record.keep_reason("INTERRUPTED", "KILLED", "interrupted")
        raise KeyboardInterrupt from stop
    except Exception as error:
        reason = str(error) if isinstance(error, PoseError) else f"{type(error).__name__}: {error}"
        record.keep_reason("FAILED", "FAILED", reason, traceback.format_exc())
        raise


def _measure_features(record: _TrialRecord, run: str, values: Settings) -> list[float]:
    """Measure keypoints instead of training."""
    data, extractor, images = open_keypoint_data(ParsedConfig(record.plan.arguments(values)))
    metrics, curves = measure_keypoints(data.cache, images, extractor.n_features)
    for name, curve in (*((name, {0: value}) for name, value in metrics.items()), *curves.items()):
        for number, value in curve.items():
            record.client.log_metric(run, name, value, step=number)
    record.client.set_terminated(run, "FINISHED")
    return record.keep_values(metrics, curves)


class _TrialRecord:
    """What Optuna and MLflow keep of a trial.

    Args:
        trial: Optuna's.
        plan: of the sweep.

    Attributes:
        client: of the store that has the trial's MLflow run.
        run: id of this run; None before it is created.
    """

    def __init__(self, trial: Trial, plan: Plan) -> None:
        self.trial, self.plan = trial, plan
        self.client = MlflowClient(plan.tracking[0])
        self.run: str | None = None

    def create_run(self, parent: str) -> str:
        """Create the trial's MLflow run in that of the study; returns its id."""
        experiment = self.client.get_experiment_by_name(self.plan.tracking[1])
        assert experiment is not None, "the study's run is in it"
        study, number = self.trial.study.study_name, self.trial.number
        tags = {PARENT_TAG: parent, "sweep.study": study, "sweep.trial": str(number), **process_tags()}
        name = f"{study} trial {number}"  # until its settings are known
        with delay_interrupts():  # the run has to be closed
            self.run = self.client.create_run(experiment.experiment_id, run_name=name, tags=tags).info.run_id
        self.trial.set_user_attr(RUN, self.run)
        with contextlib.suppress(MlflowException):  # if the user has deleted it, the trial runs all the same
            # A command that ended between two trials of this one has closed it.
            self.client.update_run(parent, status="RUNNING")
        return self.run

    def keep_values(self, found: Mapping[str, float], curves: Mapping[str, Mapping[int, float]]) -> list[float]:
        """Keep what a trial measured, for the study's table and figure; returns the objectives' values.

        Raises:
            ConfigError: one of the values is no finite number.
        """
        values = {objective.metric: found[objective.metric] for objective in self.plan.objectives}
        for metric, value in values.items():
            if not math.isfinite(value):  # Optuna would fail the trial too, but without a reason
                raise ConfigError(
                    f"{metric} came out as {value}; lower the learning rate, or leave it out of the objectives"
                )
        self.trial.set_user_attr(METRICS, {name: value for name, value in found.items() if math.isfinite(value)})
        if curves:
            self.trial.set_user_attr(CURVES, {name: list(map(list, curve.items())) for name, curve in curves.items()})
        for metric, value in values.items():
            self.client.log_metric(str(self.run), f"objective/{metric}", value)
        self.client.set_tag(str(self.run), "sweep.state", "COMPLETE")
        return list(values.values())

    def keep_reason(self, state: str, status: str, reason: str, error: str | None = None) -> None:
        """Keep why a trial has no value.

        A store that fails here must not hide what ended the trial, least of all a Ctrl-C.
        """
        shown = " ".join(reason.split())[:500]
        # Refused where another process has already failed the trial with a reason of its own.
        with contextlib.suppress(OptunaError):
            self.trial.set_user_attr(REASON, shown)
        if self.run is None:
            return
        with contextlib.suppress(MlflowException, OSError):
            self.client.set_tag(self.run, "sweep.state", state)
            self.client.set_tag(self.run, "sweep.reason", shown)
            self.client.set_terminated(self.run, status)
            if error is not None:
                self.client.log_text(self.run, error, "error.txt")
