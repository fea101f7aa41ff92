"""Runs the trials of a sweep: in this process, in several that share the study, or on a cluster.

The processes of one machine are not those of `run_tasks`: trials need what its engines do not have (joblib 1.6,
distributed 2026.8). Where one process of joblib is killed, joblib ends the others in the middle of their trials.
Workers of Dask call tasks outside their main thread, which no Ctrl-C or SIGTERM reaches, so that a trial under way
could neither be recorded as interrupted nor be queued again; and those that Dask starts for a command end with it, and
not with their trials.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from multiprocessing.connection import wait
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import Semaphore

import optuna
from mlflow import MlflowClient
from optuna import Study
from optuna.exceptions import UpdateFinishedTrialError
from optuna.storages import RDBStorage, fail_stale_trials
from optuna.trial import TrialState

from lightning_pose.concurrency.signals import STOPPING, interrupt_on
from lightning_pose.concurrency.tasks import run_tasks
from lightning_pose.runs.process import process_name
from lightning_pose.runs.tags import PROCESS
from lightning_pose.sweeps.plan import Plan
from lightning_pose.sweeps.storage import lock_study
from lightning_pose.sweeps.study import count_waiting, is_grid, load_study, open_storage, queue_again, recover_trials
from lightning_pose.sweeps.trial import run_trial

__all__ = ["Job", "run_here", "run_in_processes", "run_next_trial", "run_on_cluster"]

PATIENCE_SECONDS, POLL_SECONDS = 20.0, 0.5
INTERRUPTED = 130
ONE_TRIAL = threading.Lock()
"""Trials seed the generators of their whole process, so that workers of a cluster with several threads take turns."""


@dataclass(frozen=True)
class Job:
    """What a worker process is given; it can be pickled.

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

    def open(self) -> tuple[Study, RDBStorage]:
        """The study, with a sampler and database connections of this process's own."""
        storage = open_storage(self.storage, self.plan.tracking[0])
        return load_study(self.plan, self.study, storage), storage


def run_here(job: Job, total: int, on_end: Callable[[], None]) -> None:
    """Run this many trials in this process; fewer where a grid has no more.

    Args:
        job: what to run.
        total: number of trials.
        on_end: called after each.

    Raises:
        KeyboardInterrupt: Ctrl-C; the trial under way is queued again.
    """
    study, storage = job.open()
    # A second Ctrl-C must not end the process while it queues the trial of the first again.
    with interrupt_on([signal.SIGINT]):
        for _ in range(total):
            if not run_next_trial(study, storage, job):
                return
            on_end()


def run_next_trial(study: Study, storage: RDBStorage, job: Job) -> bool:
    """Run one trial; its exceptions are recorded, not raised. Returns False if no grid point is waiting.

    The study is locked until the trial has the name of this process, so that no other process takes it too.

    Raises:
        KeyboardInterrupt: Ctrl-C; the trial is queued again.
    """
    own: int | None = None
    interrupted = False
    with ExitStack() as lock:

        def objective(trial: optuna.Trial) -> list[float]:
            nonlocal own, interrupted
            own = trial.number
            try:
                trial.set_user_attr(PROCESS, process_name())
                lock.close()
                return run_trial(trial, job.plan, job.parent)
            except KeyboardInterrupt:
                interrupted = True
                raise

        lock.enter_context(lock_study(storage, job.study))
        if is_grid(job.plan):
            fail_stale_trials(study)  # so that grid points of a machine that is gone wait again
            if count_waiting(study) == 0:
                return False
        try:
            study.optimize(objective, n_trials=1, catch=(Exception,), gc_after_trial=True)
        except KeyboardInterrupt:
            trial = study.trials[own] if interrupted and own is not None else None
            if trial is not None and trial.state == TrialState.FAIL:  # not one that had ended before
                queue_again(study, trial, lost=False)
            raise
        except (AssertionError, ValueError, UpdateFinishedTrialError) as error:
            # Optuna raises these for a result that comes too late, as after this machine slept; or a sampler fails.
            late = isinstance(error, UpdateFinishedTrialError)
            if own is None or not (late or study.trials[own].state == TrialState.FAIL):
                raise
            if interrupted:
                raise KeyboardInterrupt from error
    return True


def run_in_processes(job: Job, total: int, on_end: Callable[[], None], workers: int) -> None:
    """Run this many trials in several processes, and each of them once.

    A trial whose process is killed does not count: it is queued again, and another process takes it.

    Args:
        job: what to run.
        total: number of trials.
        on_end: called after each.
        workers: number of processes.

    Raises:
        KeyboardInterrupt: Ctrl-C; trials under way are queued again.
        RuntimeError: a worker broke; the others have finished their trials.
    """
    context = _process_context(workers)
    left, ended = context.Semaphore(total), context.Semaphore(0)  # trials that no process has begun, that have ended
    study, storage = job.open()
    missing, running = min(workers, total), list[BaseProcess]()
    try:
        try:
            while missing or running:
                for _ in range(missing):
                    running.append(context.Process(target=_run_worker, args=(job, left, ended)))
                    running[-1].start()
                wait([process.sentinel for process in running], POLL_SECONDS)
                gone = [process for process in running if process.exitcode is not None]
                running = [process for process in running if process not in gone]
                while ended.acquire(block=False):
                    on_end()
                killed = [p for p in gone if p.exitcode == INTERRUPTED or (p.exitcode or 0) < 0]
                if any(process.exitcode and process not in killed for process in gone):
                    raise RuntimeError("a worker of the sweep broke; its traceback is above")
                if killed:
                    with lock_study(storage, job.study):
                        queued, given_up = recover_trials(study, storage, MlflowClient(job.plan.tracking[0]))
                    for _ in range(queued + sum(process.exitcode == INTERRUPTED for process in killed)):
                        left.release()
                    for _ in range(given_up):
                        on_end()
                missing = len(killed)
        except Exception:
            print("the sweep breaks off; trials under way are finished first", file=sys.stderr, flush=True)
            while left.acquire(block=False):
                pass
            for process in running:
                process.join()
            raise
    except KeyboardInterrupt:
        _interrupt_workers(running)
        raise


def run_on_cluster(job: Job, total: int, on_end: Callable[[], None], workers: int, scheduler: str) -> None:
    """Run this many trials on the workers of a Dask cluster; fewer where a grid has no more.

    A trial whose worker is killed is queued again by the next task on that machine, or once it has had no heartbeat for
    a minute. After Ctrl-C, trials under way are finished by their workers.

    Args:
        job: what to run.
        total: number of trials.
        on_end: called after each.
        workers: as for `run_tasks`.
        scheduler: likewise.

    Raises:
        ConfigError: as `run_tasks`.
    """
    for _, ran in run_tasks(_run_task, [job] * total, workers, scheduler):
        if ran:
            on_end()


def _run_task(job: Job) -> bool:
    """Run one trial in a worker of a cluster; returns False if no grid point is waiting."""
    with ONE_TRIAL:
        study, storage = job.open()
        with lock_study(storage, job.study):
            recover_trials(study, storage, MlflowClient(job.plan.tracking[0]))
        return run_next_trial(study, storage, job)


def _run_worker(job: Job, left: Semaphore, ended: Semaphore) -> None:
    """Run trials in a worker process while `left` counts any and the command is there; release `ended` after each."""
    parent = multiprocessing.parent_process()
    try:
        with interrupt_on([signal.SIGINT, *STOPPING]):
            study, storage = job.open()
            while parent is not None and parent.is_alive() and left.acquire(block=False):
                if not run_next_trial(study, storage, job):
                    return  # other commands have taken the rest of the grid
                ended.release()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _interrupt_workers(running: list[BaseProcess]) -> None:
    """End the workers as Ctrl-C does; those that received the Ctrl-C themselves ignore a second one."""
    end = time.monotonic() + PATIENCE_SECONDS
    started = [process for process in running if process.pid is not None]  # Ctrl-C may come before the last one starts
    for process in started:
        with suppress(ProcessLookupError):
            os.kill(process.pid or 0, signal.SIGINT)
    for process in started:
        process.join(max(0, end - time.monotonic()))
        if process.is_alive():
            process.kill()


def _process_context(workers: int) -> SpawnContext | ForkServerContext:
    """How processes are started: forked off a server that has the imports, which take longer than a small trial.

    A fork of this process would share its database connections, and CUDA forbids it.
    """
    # Threads of several workers would compete for the cores; torch reads this as it is imported.
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // workers)))
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    return context
