"""Who runs the trials: this process, or several that share the study and are replaced when they die."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import Any

import optuna
from mlflow import MlflowClient
from optuna import Study
from optuna.exceptions import UpdateFinishedTrialError
from optuna.storages import fail_stale_trials
from optuna.trial import FrozenTrial, TrialState

from lightning_pose.runs.process import process_name
from lightning_pose.runs.tags import PROCESS
from lightning_pose.sweeps.outages import PatientStorage
from lightning_pose.sweeps.plan import Plan
from lightning_pose.sweeps.storage import alone
from lightning_pose.sweeps.study import attach, is_grid, open_storage, queue_again, recover, waiting
from lightning_pose.sweeps.trial import run_trial

__all__ = ["Job", "run_alone", "run_together"]

PATIENCE_SECONDS = 20.0
Finished = Callable[[], None]
Taken = Callable[[int], None]


@dataclass(frozen=True)
class Job:
    """What a worker needs to know; it can be pickled.

    Attributes:
        plan: of the sweep.
        study: its name.
        storage: Optuna's address.
        parent: MLflow run id of the study.
    """

    plan: Plan
    study: str
    storage: str
    parent: str

    @property
    def client(self) -> MlflowClient:
        """Of the store that has the trials' runs."""
        return MlflowClient(self.plan.tracking[0])

    def connect(self) -> PatientStorage:
        """The study's database, by connections of this process's own."""
        return open_storage(self.storage, self.plan.tracking[0])

    def open(self, storage: PatientStorage) -> Study:
        """The study, with a sampler of this worker's own."""
        return attach(self.plan, self.study, storage)


def run_alone(job: Job, total: int, finished: Finished) -> None:
    """Run this many trials here, one after the other; fewer where a grid has no more.

    Raises:
        KeyboardInterrupt: Ctrl-C; the trial under way is queued again.
    """
    storage = job.connect()
    study = job.open(storage)
    before = signal.getsignal(signal.SIGINT)
    _hear_once()
    try:
        for _ in range(total):
            if not _run_one(study, storage, job):
                return
            finished()
    finally:
        if before is signal.default_int_handler:
            signal.signal(signal.SIGINT, before)


def _hear_once() -> None:
    """Ctrl-C counts once: a second one must not end the process while it queues the trial of the first again."""
    heard = False

    def hear(number: int, frame: FrameType | None) -> None:
        nonlocal heard
        if not heard:
            heard = True
            raise KeyboardInterrupt

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else it is ignored, or someone else's
        signal.signal(signal.SIGINT, hear)


def _run_one(study: Study, storage: PatientStorage, job: Job, taken: Taken = lambda number: None) -> bool:
    """Run one trial; its exceptions are recorded, not raised. Returns False if no grid point is waiting.

    One process at a time takes a trial, so that each is taken once, and writes down that it is its own.
    """
    own: int | None = None
    interrupted = False
    with ExitStack() as held:

        def objective(trial: optuna.Trial) -> float | list[float]:
            nonlocal own, interrupted
            own = trial.number
            try:
                trial.set_user_attr(PROCESS, process_name())
                held.close()
                taken(trial.number)
                return run_trial(trial, job.plan, job.parent)
            except KeyboardInterrupt:
                interrupted = True
                raise

        held.enter_context(alone(storage, job.study))
        if is_grid(job.plan):
            fail_stale_trials(study)  # what another machine has left undone is to be done too
            if waiting(study) == 0:
                return False
        try:
            study.optimize(objective, n_trials=1, catch=(Exception,), gc_after_trial=True)
        except KeyboardInterrupt:
            if interrupted and _trial(study, own).state == TrialState.FAIL:  # not one that was over already
                queue_again(study, _trial(study, own), died=False)
            raise
        except (AssertionError, ValueError, UpdateFinishedTrialError) as error:
            # Optuna's answers to a result that comes too late, as after this machine slept; or a sampler's mistake.
            late = isinstance(error, UpdateFinishedTrialError)
            if own is None or not (late or _trial(study, own).state == TrialState.FAIL):
                raise
            if interrupted:
                raise KeyboardInterrupt from error
    return True


def _trial(study: Study, number: int | None) -> FrozenTrial:
    return next(trial for trial in study.get_trials(deepcopy=False) if trial.number == number)


def _work(job: Job, orders: Connection) -> None:
    """A worker process: one trial for each order, until there are none."""
    _hear_once()
    try:
        storage = job.connect()
        study = job.open(storage)
        while orders.recv():
            ran = _run_one(study, storage, job, partial(_send, orders))
            orders.send("done" if ran else "none")
    except KeyboardInterrupt:
        _send(orders, "again")
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the one who gives orders is gone


def _send(orders: Connection, news: str | int) -> None:
    with contextlib.suppress(OSError):  # a trial is worth its end, even if nobody waits for it
        orders.send(news)


@dataclass
class _Worker:
    process: Any
    orders: Connection
    busy: bool = False
    trial: int | None = None


def run_together(job: Job, total: int, finished: Finished, workers: int) -> None:
    """Run this many trials in several processes, and each of them once.

    A trial whose process ends does not count: it is queued again, and another worker takes it.

    Raises:
        KeyboardInterrupt: Ctrl-C; trials under way are queued again.
        RuntimeError: a worker broke; the others have finished their trials.
    """
    crew: list[_Worker] = []
    try:
        try:
            _give_orders(job, total, finished, workers, crew)
        except Exception:
            print("the sweep breaks off; trials under way are finished first", file=sys.stderr, flush=True)
            _dismiss(crew, None)
            raise
    except KeyboardInterrupt:
        _stop(crew)
        raise
    finally:
        _dismiss(crew, PATIENCE_SECONDS)


def _give_orders(job: Job, total: int, finished: Finished, workers: int, crew: list[_Worker]) -> None:
    context = _context(workers)
    storage = job.connect()
    study = job.open(storage)
    left = total
    while left > 0 or any(worker.busy for worker in crew):
        while len(crew) < min(workers, left + sum(worker.busy for worker in crew)):
            crew.append(_start(context, job))
        for worker in crew:
            if not worker.busy and left > 0 and _order(worker):
                left -= 1
        for worker in _heard(crew):
            news = _report(worker)
            if isinstance(news, int):
                worker.trial = news
                continue
            again = news == "again"
            if news == "dead":
                crew.remove(worker)
                _check_killed(worker)
                with alone(storage, job.study):
                    queued = recover(study, storage, job.client)
                again = worker.trial is None or worker.trial in queued
            if news == "none":
                left = 0  # other commands have taken the rest
            elif worker.busy and again:
                left += 1
            elif worker.busy:
                finished()
            worker.busy, worker.trial = False, None


def _dismiss(crew: list[_Worker], patience: float | None) -> None:
    """Let workers end with the trial that they have; None waits for it however long it takes."""
    for worker in crew:
        worker.orders.close()
    for worker in crew:
        worker.process.join(patience)
        if worker.process.is_alive():
            worker.process.kill()


def _context(workers: int) -> Any:
    """How processes are started: forked off one that has the imports, which take longer than a small trial, and nothing
    else; a fork of this one would share its database connections, and CUDA forbids it.
    """
    # Threads of several workers would fight for the cores; torch reads this as it is imported.
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // workers)))
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    return context


def _start(context: Any, job: Job) -> _Worker:
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(job, theirs))
    process.start()
    theirs.close()  # so that the pipe breaks when the worker dies
    return _Worker(process, ours)


def _order(worker: _Worker) -> bool:
    try:
        worker.orders.send(True)
    except OSError:
        return False  # it has died; the pipe says so when it is heard
    worker.busy = True
    return True


def _heard(crew: list[_Worker]) -> list[_Worker]:
    ready = wait([worker.orders for worker in crew])
    return [worker for worker in crew if worker.orders in ready]


def _report(worker: _Worker) -> str | int:
    """What a worker says: the number of the trial it has taken; then `done`, or `again` where it was interrupted, or
    `none` where a grid has no more; `dead` if it is.
    """
    try:
        return worker.orders.recv()
    except (EOFError, OSError):
        return "dead"


def _check_killed(worker: _Worker) -> None:
    """A worker that was killed is replaced, one that broke is not: the next would break in the same way."""
    worker.process.join()
    if worker.process.exitcode > 0:
        raise RuntimeError("a worker of the sweep broke; its traceback is above")


def _stop(crew: list[_Worker]) -> None:
    """End the workers that did not receive the Ctrl-C themselves."""
    for worker in crew:
        worker.process.join(1.0)
        if worker.process.is_alive():
            with contextlib.suppress(ProcessLookupError):
                os.kill(worker.process.pid, signal.SIGINT)
