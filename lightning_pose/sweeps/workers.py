"""Who runs the trials: this process, or several that share the study and are replaced when they die."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

import optuna
from mlflow import MlflowClient
from optuna import Study
from optuna.trial import FrozenTrial, TrialState

from lightning_pose.sweeps.plan import Plan
from lightning_pose.sweeps.study import attach, open_storage, queue_again, recover
from lightning_pose.sweeps.trial import PROCESS, process_name, run_trial

__all__ = ["Job", "run_alone", "run_together"]

PATIENCE_SECONDS = 20.0
Finished = Callable[[], None]


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

    def open(self, worker: int = 0) -> Study:
        """The study, with a sampler of this worker's own."""
        return attach(self.plan, self.study, open_storage(self.storage), worker)


def run_alone(job: Job, total: int, finished: Finished) -> None:
    """Run this many trials here, one after the other.

    Raises:
        KeyboardInterrupt: Ctrl-C; the trial under way is queued again.
    """
    study = job.open()
    for _ in range(total):
        _run_one(study, job)
        finished()


def _run_one(study: Study, job: Job) -> None:
    """One trial; what goes wrong in it is its own affair."""

    def objective(trial: optuna.Trial) -> float | list[float]:
        return run_trial(trial, job.plan, job.parent)

    try:
        study.optimize(objective, n_trials=1, catch=(Exception,), gc_after_trial=True)
    except KeyboardInterrupt:
        own = _own_interrupted(study)
        if own is not None:
            queue_again(study, own.number, limit=None)
        raise


def _own_interrupted(study: Study) -> FrozenTrial | None:
    """The last trial of this process, if it has just failed."""
    own = [t for t in study.get_trials(deepcopy=False) if t.user_attrs.get(PROCESS) == process_name()]
    return own[-1] if own and own[-1].state == TrialState.FAIL else None


def _work(job: Job, worker: int, orders: Connection) -> None:
    """A worker process: one trial for each order, until there are none."""
    try:
        study = job.open(worker)
        while orders.recv():
            _run_one(study, job)
            orders.send("done")
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second one would only spoil the exit
        with contextlib.suppress(OSError):
            orders.send("again")
    except EOFError:
        pass  # the one who gives orders is gone


@dataclass
class _Worker:
    process: Any
    orders: Connection
    busy: bool = False


def run_together(job: Job, total: int, finished: Finished, workers: int) -> None:
    """Run this many trials in several processes, and each of them once.

    A trial whose process dies does not count: it is queued again, and another worker takes it.

    Raises:
        KeyboardInterrupt: Ctrl-C; trials under way are queued again.
    """
    context = _context(workers)
    study, storage = job.open(), open_storage(job.storage)
    left, done, started = total, 0, 0
    crew: list[_Worker] = []
    try:
        while done < total:
            while len(crew) < min(workers, left + sum(worker.busy for worker in crew)):
                started += 1
                crew.append(_start(context, job, started))
            for worker in crew:
                if not worker.busy and left > 0 and _order(worker):
                    left -= 1
            for worker in _heard(crew):
                news = _report(worker)
                again = news == "again"
                if news == "dead":
                    crew.remove(worker)
                    _check_killed(worker)
                    again = recover(study, storage, job.client) > 0
                if worker.busy and again:
                    left += 1
                elif worker.busy:
                    done += 1
                    finished()
                worker.busy = False
    except KeyboardInterrupt:
        _stop(crew)
        raise
    finally:
        for worker in crew:
            worker.orders.close()
            worker.process.join(PATIENCE_SECONDS)
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


def _start(context: Any, job: Job, number: int) -> _Worker:
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(job, number, theirs))
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


def _report(worker: _Worker) -> str:
    """What a worker says of its trial: `done`, or `again` where it was interrupted; `dead` if it is."""
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
    """Let workers end that did not hear the Ctrl-C themselves."""
    for worker in crew:
        worker.process.join(1.0)
        if worker.process.is_alive():
            with contextlib.suppress(ProcessLookupError):
                os.kill(worker.process.pid, signal.SIGINT)
