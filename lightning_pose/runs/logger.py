"""MLflowLogger: Lightning's MLflow logger with the project's defaults."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from lightning.fabric.utilities.rank_zero import rank_zero_only
from lightning.pytorch.loggers import MLFlowLogger

from lightning_pose.concurrency.signals import delay_interrupts
from lightning_pose.errors import ConfigError
from lightning_pose.paths import STORE_VARIABLE, default_tracking_uri
from lightning_pose.runs.client import BufferedClient, is_unreachable, wait_while_locked
from lightning_pose.runs.process import has_owner_died, process_tags
from lightning_pose.runs.reader import mask_passwords
from lightning_pose.runs.store import prepare_store, sqlite_file
from lightning_pose.runs.tags import PARENT_TAG

if TYPE_CHECKING:
    from mlflow import MlflowClient

__all__ = ["MLflowLogger", "flatten_settings", "keep_environment"]

TRAINING = ("train/", "val/", "epoch")
"""How the names of metrics begin that have one value a step."""


class MLflowLogger(MLFlowLogger):
    """Lightning's MLflow logger, with a database by default, and a status that shows how the run ended.

    A run that a user or a signal stops ends as KILLED, and one that an error stops as FAILED. A run whose process was
    killed outright is found by the next run on the same machine, and marked KILLED then.

    Args:
        experiment_name: MLflow experiment.
        run_name: name of the run; derived from architecture, scene and main setting if not given.
        tracking_uri: MLflow store; `MLFLOW_TRACKING_URI`, else `sqlite:///mlruns/mlflow.db`.
        run_id: continue this run.
        root: folder of the default database and its artifacts.

    Attributes:
        uri: the tracking store's address.
        run_name: the name that the user gave, if any.
        stopped_as: the status of a run that Lightning reports as failed.
    """

    def __init__(
        self,
        experiment_name: str = "lightning_pose",
        run_name: str | None = None,
        tracking_uri: str | None = None,
        run_id: str | None = None,
        root: str = "mlruns",
    ) -> None:
        # alembic and mlflow announce each table of a new database on the terminal.
        for noisy in ("alembic", "mlflow.tracking.fluent"):
            logging.getLogger(noisy).setLevel(logging.WARNING)
        # It announces tables too, and prints the traceback of an error that it raises.
        logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)
        logging.getLogger("lightning.pytorch.loggers.mlflow").setLevel(logging.ERROR)  # of a new experiment
        uri = prepare_store(tracking_uri or default_tracking_uri(root))
        local = uri.startswith("sqlite:///")
        super().__init__(
            experiment_name=experiment_name,
            run_name=run_name,
            tracking_uri=uri,
            run_id=run_id,
            tags=process_tags(),  # at once: a run without them could not be closed for a process that is killed now
            artifact_location=(Path(root) / "artifacts").resolve().as_uri() if local else None,
        )
        self._writer = BufferedClient(uri)
        self.uri = uri
        self.run_name = run_name
        self.stopped_as = "FAILED"
        self._opened = False
        self._claimed = False
        self._resumes = run_id is not None
        self._known: dict[str, dict[int, float]] = {}

    @property
    def experiment(self) -> MlflowClient:
        """The MLflow client of the store, with the run created; Lightning's code uses it by this name.

        Raises:
            ConfigError: the store is gone before there is a run.
        """
        if not self._opened:
            from mlflow.exceptions import MlflowException

            try:
                wait_while_locked(self._open_run)
            except MlflowException as error:
                if not is_unreachable(error):
                    raise
                reason = mask_passwords(str(error).strip().partition("\n")[0])[:200]
                raise ConfigError(f"the MLflow store {mask_passwords(self.uri)} takes no run ({reason})") from error
        return self._writer

    def _open_run(self) -> None:
        """Find or create the experiment and the run."""
        from mlflow.exceptions import MlflowException

        # The run that it creates has to be closed; a server may take minutes not to answer.
        with keep_environment(), delay_interrupts() if sqlite_file(self.uri) else nullcontext():
            try:
                _ = super().experiment
            except MlflowException as error:
                if error.error_code != "RESOURCE_ALREADY_EXISTS":
                    raise
                _ = super().experiment  # another process has created the experiment at the same time
            self._opened = True

    @property
    def client(self) -> BufferedClient:
        """The MLflow client of the store, with the run created and this process recorded as its owner."""
        _, client = self.experiment, self._writer
        if not self._claimed:
            self._claimed = True
            # A resumed run belongs to this process now; with the tags of the ended one it would be closed.
            for name, value in process_tags().items():
                client.set_tag(str(self.run_id), name, value)
            self._close_stale_runs(client)
        return client

    def _close_stale_runs(self, client: MlflowClient) -> None:
        """Mark runs of this machine whose process no longer exists as KILLED.

        A sweep's run has the tags of the last command's process; it stays open while one of its trials runs.
        """
        running = client.search_runs([str(self.experiment_id)], "attributes.status = 'RUNNING'")
        dead = [run for run in running if run.info.run_id != self.run_id and has_owner_died(run)]
        closed = {run.info.run_id for run in dead}
        held = {run.data.tags.get(PARENT_TAG) for run in running if run.info.run_id not in closed}
        for run_id in closed - held:
            client.set_terminated(run_id, "KILLED")

    @rank_zero_only
    def log_hyperparams(self, params: Mapping[str, object]) -> None:
        """Log what the run does not have yet: MLflow refuses to change a parameter, and a resumed run may."""
        known = self.client.get_run(str(self.run_id)).data.params
        flat = flatten_settings(params)
        super().log_hyperparams({name: value for name, value in flat.items() if name not in known})

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log metrics, now or some seconds later; a run keeps what it has of a step."""
        new = {name: value for name, value in metrics.items() if not self._has(name, step or 0, float(value))}
        with self.client.hold():
            super().log_metrics(new, step)
        if self.client.is_due:
            self.send_metrics()

    def send_metrics(self) -> None:
        """Send the metrics that wait for others; Ctrl-C and other signals take effect once they are written."""
        with delay_interrupts() if sqlite_file(self.uri) else nullcontext():
            self.client.send_metrics()

    def _has(self, name: str, step: int, value: float) -> bool:
        """Whether the run has a metric of this step: any value of training, or this one of what is measured later.

        A run that goes on after `kill -9` may do an epoch, or its test, once more.
        """
        if name not in self._known:
            history = self.client.get_metric_history(str(self.run_id), name) if self._resumes else []
            self._known[name] = {metric.step: metric.value for metric in history}
        known = self._known[name]
        if step in known and (name.startswith(TRAINING) or known[step] == value):
            return True
        known[step] = value
        return False

    @rank_zero_only
    def finalize(self, status: str = "success") -> None:
        """End the run as FINISHED, or as `stopped_as` if Lightning reports that it failed."""
        if self._opened:
            self.client.set_terminated(str(self.run_id), self.stopped_as if status == "failed" else "FINISHED")
            self.client.finish()


@contextmanager
def keep_environment() -> Iterator[None]:
    """Restore `MLFLOW_TRACKING_URI` at the end: MLflow sets it to its store, and the next logger would read it."""
    before = os.environ.get(STORE_VARIABLE)
    try:
        yield
    finally:
        os.environ.pop(STORE_VARIABLE, None)
        if before is not None:
            os.environ[STORE_VARIABLE] = before


def flatten_settings(config: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """Nested settings by dotted name; `init_args` is left out, so `model.units` and not `model.init_args.units`."""
    flat: dict[str, object] = {}
    for key, value in config.items():
        name = prefix if key == "init_args" else f"{prefix}.{key}" if prefix else str(key)
        if isinstance(value, Mapping):
            flat |= flatten_settings(value, name)
        else:
            flat[name] = value
    return flat
