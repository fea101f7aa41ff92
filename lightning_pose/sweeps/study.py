"""Optuna's study: where it is kept, how it samples and prunes, and which trials wait in it."""

from __future__ import annotations

import json
import socket
import time
import warnings
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import optuna
from mlflow import MlflowClient
from optuna import Study, pruners, samplers
from optuna.exceptions import ExperimentalWarning, UpdateFinishedTrialError
from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, IntegrityError, OperationalError, SQLAlchemyError

from lightning_pose.errors import ConfigError
from lightning_pose.sweeps.plan import Plan
from lightning_pose.sweeps.record import close_run
from lightning_pose.sweeps.space import grid, nearest
from lightning_pose.sweeps.trial import PROCESS, REASON, RUN
from lightning_pose.tracking import alive

__all__ = [
    "attach",
    "enqueue_grid",
    "is_grid",
    "open_storage",
    "open_study",
    "queue_again",
    "recover",
    "shown",
    "waiting",
]

HEARTBEAT_SECONDS, GRACE_SECONDS = 15, 60
RETRIES = 3
CELL = "grid_cell"

SAMPLERS: dict[str, Callable[..., samplers.BaseSampler]] = {
    "tpe": samplers.TPESampler,
    "gp": samplers.GPSampler,
    "random": samplers.RandomSampler,
    "grid": samplers.RandomSampler,  # its cells wait in the study, where no two workers can take the same one
    "cmaes": samplers.CmaEsSampler,
    "nsga2": samplers.NSGAIISampler,
    "nsga3": samplers.NSGAIIISampler,
    "qmc": samplers.QMCSampler,
}
SYNONYMS = {"nsgaii": "nsga2", "nsgaiii": "nsga3", "sobol": "qmc"}
PRUNERS: dict[str, Callable[..., pruners.BasePruner]] = {
    "none": pruners.NopPruner,
    "median": pruners.MedianPruner,
    "percentile": pruners.PercentilePruner,
    "hyperband": pruners.HyperbandPruner,
    "halving": pruners.SuccessiveHalvingPruner,
    "threshold": pruners.ThresholdPruner,
}


def is_grid(plan: Plan) -> bool:
    """Whether the sweep has an end of its own."""
    return _plain(plan.sampler["name"]) == "grid"


def open_storage(url: str) -> RDBStorage:
    """Connect to Optuna's database; a trial whose process falls silent is failed and queued again.

    Raises:
        ConfigError: the database cannot be reached or read.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.filterwarnings("ignore", category=ExperimentalWarning)
    if url.startswith("sqlite:///"):
        Path(url.removeprefix("sqlite:///")).parent.mkdir(parents=True, exist_ok=True)
    try:
        try:
            return _connect(url)
        except (IntegrityError, OperationalError):
            time.sleep(1)  # another command may be making the same tables
            return _connect(url)
    except ImportError as error:
        raise ConfigError(f"--storage {shown(url)} needs a database driver ({error.__cause__}); install it") from error
    except (SQLAlchemyError, RuntimeError, OSError) as error:
        told = str(error).splitlines()[0]
        raise ConfigError(
            f"--storage {shown(url)} cannot be used ({told}); give an address such as sqlite:///DIR/optuna.db"
        ) from error


def _connect(url: str) -> RDBStorage:
    patience = {"connect_args": {"timeout": 60}} if url.startswith("sqlite") else {"pool_pre_ping": True}
    return RDBStorage(
        url,
        engine_kwargs=patience,
        heartbeat_interval=HEARTBEAT_SECONDS,
        grace_period=GRACE_SECONDS,
        heartbeat_stale_trial_callback=_retry,
    )


def shown(url: str) -> str:
    """A database's address without its password."""
    try:
        return make_url(url).render_as_string(hide_password=True)
    except ArgumentError:
        return url


def open_study(plan: Plan, name: str, storage: RDBStorage) -> Study:
    """Create the study, or go on with it.

    Raises:
        ConfigError: the sampler or pruner is unknown or does not suit, or a study of this name searched otherwise.
    """
    directions = [
        StudyDirection.MAXIMIZE if objective.maximize else StudyDirection.MINIMIZE for objective in plan.objectives
    ]
    sampler, pruner = _sampler(plan), _pruner(plan)
    if is_grid(plan):
        grid(plan.space)  # before a study is made that cannot be run
    known = name in optuna.get_all_study_names(storage)
    if known:
        study = optuna.load_study(study_name=name, storage=storage, sampler=sampler, pruner=pruner)
        _check_same(study, plan)
        return study
    study = optuna.create_study(
        study_name=name, storage=storage, directions=directions, sampler=sampler, pruner=pruner, load_if_exists=True
    )
    for what, text in plan.describe().items():
        study.set_user_attr(what, text)
    study.set_metric_names([objective.metric for objective in plan.objectives])
    return study


def attach(plan: Plan, name: str, storage: RDBStorage, worker: int = 0) -> Study:
    """The study as one worker sees it: with a sampler that draws what no other worker and no earlier command drew."""
    study = optuna.load_study(study_name=name, storage=storage)
    drawn = len(study.get_trials(deepcopy=False))
    study.sampler = _sampler(plan, seed=plan.seed + drawn + 100_003 * worker)
    study.pruner = _pruner(plan)
    return study


def _check_same(study: Study, plan: Plan) -> None:
    for what, text in plan.describe().items():
        if study.user_attrs.get(what) != text:
            raise ConfigError(
                f"the study {study.study_name} exists with another {what}; "
                "give this one a name of its own with --study, or undo the change"
            )


def _plain(name: str) -> str:
    plain = name.lower().replace("-", "").replace("_", "").replace("successive", "")
    return SYNONYMS.get(plain, plain)


def _sampler(plan: Plan, seed: int | None = None) -> samplers.BaseSampler:
    given = dict(plan.sampler)
    name = _plain(given.pop("name"))
    if name not in SAMPLERS:
        raise ConfigError(f"sampler {plan.sampler['name']!r} is not known; {nearest(name, list(SAMPLERS))}")
    if name == "cmaes" and len(plan.objectives) > 1:
        raise ConfigError("sampler cmaes serves one objective; take nsga2 or tpe for several")
    if name == "cmaes" and find_spec("cmaes") is None:  # Optuna would find out in the middle of the sweep
        raise ConfigError("sampler cmaes needs the package cmaes; `uv pip install cmaes` installs it, or take tpe")
    options: dict[str, Any] = {"seed": plan.seed if seed is None else seed}
    if name == "tpe":
        options["constant_liar"] = True  # workers keep away from what others are trying
    if name == "cmaes":
        options["warn_independent_sampling"] = False
    return _build(SAMPLERS[name], options | given, f"sampler {name}")


def _pruner(plan: Plan) -> pruners.BasePruner:
    given = dict(plan.pruner)
    name = _plain(given.pop("name"))
    comparable = len(plan.objectives) == 1 and plan.objectives[0].metric.startswith("val/")
    if name == "default":
        name = "median" if comparable else "none"
    if name not in PRUNERS:
        raise ConfigError(f"pruner {plan.pruner['name']!r} is not known; {nearest(name, list(PRUNERS))}")
    if name != "none" and not comparable:
        raise ConfigError(f"pruner {name} needs one objective of validation frames; take pruner none")
    options: dict[str, Any] = {"percentile": 25.0} if name == "percentile" else {}
    return _build(PRUNERS[name], options | given, f"pruner {name}")


def _build(kind: Callable[..., Any], options: Mapping[str, Any], what: str) -> Any:
    try:
        return kind(**options)
    except ImportError as error:
        raise ConfigError(f"{what} needs another package ({error.__cause__ or error}); install it") from error
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{what} does not take these options ({error}); see Optuna's {kind.__name__}") from error  # type: ignore[attr-defined]


def enqueue_grid(study: Study, plan: Plan) -> None:
    """Let every cell of the grid wait in the study that is not in it yet, whatever became of it."""
    there = {trial.user_attrs.get(CELL) for trial in study.get_trials(deepcopy=False)}
    for cell in grid(plan.space, plan.seed):
        name = json.dumps(cell, sort_keys=True)
        if name not in there:
            study.enqueue_trial(cell, user_attrs={CELL: name})


def waiting(study: Study) -> int:
    """How many trials wait in the study."""
    return len(study.get_trials(deepcopy=False, states=(TrialState.WAITING,)))


def _retry(study: Study, trial: FrozenTrial, limit: int | None = RETRIES) -> None:
    """Queue a trial again that was no failure of its own; what kills its process every time has an end."""
    trial.user_attrs = {k: v for k, v in trial.user_attrs.items() if k not in (PROCESS, REASON, RUN)}
    RetryHeartbeatStaleTrialCallback(max_retry=limit)(study, trial)


def queue_again(study: Study, number: int, limit: int | None = RETRIES) -> bool:
    """Queue a trial again that was interrupted or whose process died; False where that happened too often."""
    before = len(study.get_trials(deepcopy=False))
    trial = next(t for t in study.get_trials() if t.number == number)
    _retry(study, trial, limit)
    return len(study.get_trials(deepcopy=False)) > before


def recover(study: Study, storage: RDBStorage, client: MlflowClient) -> int:
    """Fail the trials of this machine whose process is gone, without waiting for their hearts to stop, and queue them
    again.

    Returns:
        How many were queued.
    """
    queued = 0
    for trial in study.get_trials(states=(TrialState.RUNNING,)):
        host, _, process = trial.user_attrs.get(PROCESS, "").rpartition(":")
        if host != socket.gethostname() or alive(int(process)):
            continue
        try:
            storage.set_trial_user_attr(trial._trial_id, REASON, "its process died")
            storage.set_trial_state_values(trial._trial_id, TrialState.FAIL)
        except UpdateFinishedTrialError:
            continue  # another worker was faster
        close_run(client, trial.user_attrs.get(RUN))
        queued += queue_again(study, trial.number)
    return queued
