"""BufferedClient: an MLflow client whose writes do not end training when the store is gone; they are sent later."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TypeVar, cast

from mlflow import MlflowClient
from mlflow.entities import Metric, Param, Run, RunData, RunTag
from mlflow.exceptions import MlflowException
from sqlalchemy.exc import SQLAlchemyError

from lightning_pose.runs.pace import Pace
from lightning_pose.runs.reader import mask_passwords

__all__ = ["BufferedClient", "is_unreachable", "wait_while_locked"]

WRITES = (
    "log_artifact",
    "log_artifacts",
    "log_batch",
    "log_dict",
    "log_figure",
    "log_text",
    "set_tag",
    "set_terminated",
    "update_run",
)
"""Methods of `MlflowClient` that are tried again later."""

READS = ("get_experiment_by_name", "get_metric_history", "search_runs")
"""Methods of `MlflowClient` that wait while another process has locked the store."""

REFUSALS = {
    "ALREADY_EXISTS",
    "BAD_REQUEST",
    "INVALID_PARAMETER_VALUE",
    "INVALID_STATE",
    "MALFORMED_REQUEST",
    "RESOURCE_ALREADY_EXISTS",
    "RESOURCE_DOES_NOT_EXIST",
}
"""What a store says of a request that is wrong; it would refuse it later, too."""

MOST_METRICS = 1000
"""Metrics that MLflow takes at once."""

WAIT_SECONDS = 5.0
"""The shortest time between two attempts to reach a store that is gone."""

GONE_SECONDS = 10.0
"""How long a command waits for a server at its end."""

SHARE = 10
"""So many times as long as the last attempt took is the time until the next one: a tenth of training at the most."""

LOCKED_SECONDS = 60.0
"""How long another process may lock an SQLite store; MLflow itself waits 20 seconds."""

LOCKED_PAUSE_SECONDS = 0.2
"""Time between two attempts to use a store that is locked."""

log = logging.getLogger("lightning_pose")

Write = Callable[[], object]
T = TypeVar("T")


class BufferedClient(MlflowClient):
    """An MLflow client that keeps what the store does not take, in order, and sends it when the store is back.

    Whatever is wrong with a write itself is raised as usual. A run can be read while the store is gone if it was read
    before; it then has the parameters and tags that were to be written since.

    Args:
        uri: the tracking store.
    """

    def __init__(self, uri: str) -> None:
        super().__init__(uri)
        self._uri = uri
        self._pending: deque[Write] = deque()
        self._holds = False
        self._waiting: dict[str, list[Metric]] = {}
        self._pace = Pace()
        self._lost = 0
        self._next_attempt = 0.0
        self._gone_since = ""
        self._is_writing = False
        self._is_locked = False
        self._runs: dict[str, Run] = {}
        for name in WRITES:
            # As attributes of the object, in place of nine methods with the signatures of MLflow's.
            setattr(self, name, partial(self._write, name, getattr(self, name)))
        for name in READS:
            setattr(self, name, partial(self._read, getattr(self, name)))

    @property
    def is_due(self) -> bool:
        """Whether metrics that wait for others are to be sent."""
        return self._pace.is_due

    @contextmanager
    def hold(self) -> Iterator[None]:
        """Metrics that are logged here wait for `send_metrics`, or for whatever else is written or read."""
        self._holds = True
        try:
            yield
        finally:
            self._holds = False

    def send_metrics(self) -> None:
        """Send the metrics that wait for others: many in one transaction take little longer than one."""
        if self._is_writing:
            return
        for run_id, metrics in list(self._waiting.items()):
            try:
                with self._pace.measure():
                    for first in range(0, len(metrics), MOST_METRICS):
                        self.attempt(partial(super().log_batch, run_id, metrics[first : first + MOST_METRICS]))
            except MlflowException:  # refused, such as of a run that is deleted: it would be the next time, too
                del self._waiting[run_id]
                raise
            del self._waiting[run_id]

    def attempt(self, write: Write) -> None:
        """Do something that writes to the store; keep it for later while the store is gone."""
        if self._is_writing:  # MLflow's own methods call each other
            write()
            return
        if self._pending and time.monotonic() >= self._next_attempt:
            self._send_pending()
        if self._pending or not self._try(write):
            self._pending.append(write)

    def finish(self) -> None:
        """Send what is kept; wait for the store, and say what is missing there if it does not come back."""
        self.send_metrics()
        began = time.monotonic()
        while self._pending and not self._send_pending():
            if time.monotonic() - began >= (LOCKED_SECONDS if self._is_locked else GONE_SECONDS):
                break
            time.sleep(1.0)
        missing = len(self._pending) + self._lost
        if missing:
            log.warning(
                "%d entries (metrics, parameters, files) since %s are not in %s, which does not answer",
                missing,
                self._gone_since,
                mask_passwords(self._uri),
            )

    def get_run(self, run_id: str) -> Run:
        """Read a run; while the store is gone, as it was read last, with what is to be written since."""
        self.send_metrics()
        known = self._runs.get(run_id)
        if known is not None and self._pending and time.monotonic() < self._next_attempt:
            return known
        try:
            read = partial(super().get_run, run_id)
            self._runs[run_id] = read() if known is not None else wait_while_locked(read)
        except (MlflowException, SQLAlchemyError, OSError) as error:
            if known is None or not is_unreachable(error):
                raise
        return self._runs[run_id]

    def _write(self, name: str, method: Callable[..., object], /, run_id: str, *args: object, **kwargs: object) -> None:
        """Call one of `WRITES`, now or later."""
        if not self._is_writing:
            if self._holds and name == "log_batch":
                self._waiting.setdefault(run_id, []).extend(cast(list[Metric], kwargs["metrics"]))
                return
            self.send_metrics()
            self._remember(name, run_id, args, kwargs)
        self.attempt(partial(method, run_id, *args, **kwargs))

    def _read(self, method: Callable[..., object], /, *args: object, **kwargs: object) -> object:
        """Call one of `READS`."""
        self.send_metrics()
        return wait_while_locked(partial(method, *args, **kwargs))

    def _remember(self, name: str, run_id: str, args: tuple[object, ...], kwargs: dict[str, object]) -> None:
        """Note in the run as it was read last what is written to it."""
        known = self._runs.get(run_id)
        if known is None:
            return
        params, tags = dict(known.data.params), dict(known.data.tags)
        given = kwargs.get("params")
        if name == "log_batch" and isinstance(given, list):
            params |= {param.key: param.value for param in given}
        elif name == "set_tag" and len(args) == 2:
            tags[str(args[0])] = str(args[1])
        else:
            return
        data = RunData([], [Param(*item) for item in params.items()], [RunTag(*item) for item in tags.items()])
        self._runs[run_id] = Run(known.info, data)

    def _try(self, write: Write) -> bool:
        """Whether the store took a write; it is asked again later where it did not answer."""
        started = time.monotonic()
        self._is_writing = True
        try:
            write()
        except (MlflowException, SQLAlchemyError, OSError) as error:
            if not is_unreachable(error):
                raise
            self._is_locked = is_locked(error)
            now = time.monotonic()
            self._next_attempt = now + max(WAIT_SECONDS, SHARE * (now - started))
            if not self._gone_since:
                self._gone_since = time.strftime("%H:%M:%S")
                log.warning(
                    "%s does not take what the run logs (%s); training goes on, and it is sent later",
                    mask_passwords(self._uri),
                    mask_passwords(str(error).strip().partition("\n")[0])[:200],
                )
            return False
        finally:
            self._is_writing = False
        return True

    def _send_pending(self) -> bool:
        """Send what is kept; return whether all of it is sent."""
        count = len(self._pending)
        while self._pending:
            try:
                if not self._try(self._pending[0]):
                    return False
            except (MlflowException, OSError):
                self._lost += 1  # such as a file that is gone meanwhile
            self._pending.popleft()
        log.warning("%s answers again; %d entries that were kept are sent", mask_passwords(self._uri), count)
        if not self._lost:
            self._gone_since = ""
        return True


def is_locked(error: Exception) -> bool:
    """Whether a store says that another process has locked it: no process should do that for long."""
    return "database is locked" in str(error)


def wait_while_locked(ask: Callable[[], T]) -> T:
    """What a store answers; it is asked again while another process has locked it, for `LOCKED_SECONDS` at most."""
    deadline = time.monotonic() + LOCKED_SECONDS
    while True:
        try:
            return ask()
        except (MlflowException, SQLAlchemyError) as error:
            if not is_locked(error) or time.monotonic() >= deadline:
                raise
        time.sleep(LOCKED_PAUSE_SECONDS)


def is_unreachable(error: Exception) -> bool:
    """Whether an exception means that the store is gone, locked or full, and not that a request is wrong."""
    if isinstance(error, MlflowException):
        return error.error_code not in REFUSALS
    return not isinstance(error, FileNotFoundError)
