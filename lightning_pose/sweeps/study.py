"""Optuna's study: where it is kept, how it samples and prunes, and which trials wait in it."""

from __future__ import annotations

import copy
import json
import sys
from collections.abc import Callable, Mapping
from functools import partial
from importlib.util import find_spec
from typing import Any

import optuna
from mlflow import MlflowClient
from optuna import Study, pruners, samplers
from optuna.exceptions import UpdateFinishedTrialError
from optuna.storages import RetryHeartbeatStaleTrialCallback, fail_stale_trials
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState

from lightning_pose.errors import ConfigError
from lightning_pose.runs.process import has_died
from lightning_pose.runs.tags import PROCESS, REASON, RUN
from lightning_pose.sweeps.outages import PatientStorage
from lightning_pose.sweeps.parent_run import close_run
from lightning_pose.sweeps.plan import Plan
from lightning_pose.sweeps.space import grid, nearest
from lightning_pose.sweeps.storage import alone, connect

__all__ = [
    "attach",
    "enqueue_grid",
    "is_grid",
    "open_storage",
    "open_study",
    "queue_again",
    "recover",
    "waiting",
]

DEATHS_FORGIVEN = 3
DEATHS = "deaths"  # of a trial's processes so far, under whatever number it ran
CELL = "grid_cell"
SEEDS = "samplers"  # how many there have been

SAMPLERS: dict[str, Callable[..., samplers.BaseSampler]] = {
    "tpe": samplers.TPESampler,
    "gp": samplers.GPSampler,
    "random": samplers.RandomSampler,
    "grid": samplers.RandomSampler,  # its cells wait in the study, and nothing else is ever drawn
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


def open_storage(url: str, tracking: str) -> PatientStorage:
    """Connect to Optuna's database; a trial whose process falls silent is failed and queued again.

    Args:
        url: of the database.
        tracking: MLflow's address, where the trials' runs are.

    Raises:
        ConfigError: the database cannot be reached or read.
    """
    return connect(url, partial(_fell_silent, tracking))


def open_study(plan: Plan, name: str, storage: PatientStorage) -> Study:
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


def attach(plan: Plan, name: str, storage: PatientStorage) -> Study:
    """The study as one worker sees it: with a sampler that draws what no other worker and no other command draws."""
    study = optuna.load_study(study_name=name, storage=storage)
    with alone(storage, name):
        number = study.user_attrs.get(SEEDS, 0)
        study.set_user_attr(SEEDS, number + 1)
    study.sampler = _sampler(plan, seed=plan.seed + number)
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
        raise ConfigError("sampler cmaes needs the package cmaes; `uv sync --extra sweep` installs it, or take tpe")
    options: dict[str, Any] = {"seed": plan.seed if seed is None else seed}
    if name == "qmc":
        options["seed"] = plan.seed  # all workers take their points from one sequence, which the study counts
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
    """Let every cell of the grid wait in the study that is not in it yet, whatever became of it.

    The caller keeps others out (`alone`), or two commands would queue the same cell.
    """
    there = {trial.user_attrs.get(CELL) for trial in study.get_trials(deepcopy=False)}
    for cell in grid(plan.space, plan.seed):
        name = json.dumps(cell, sort_keys=True)
        if name not in there:
            study.enqueue_trial(cell, user_attrs={CELL: name})


def waiting(study: Study) -> int:
    """How many trials wait in the study."""
    return len(study.get_trials(deepcopy=False, states=(TrialState.WAITING,)))


def queue_again(study: Study, trial: FrozenTrial, died: bool) -> int | None:
    """Queue a trial again that was no failure of its own; what kills its process every time has an end.

    Args:
        study: that has it.
        trial: which has ended.
        died: whether its process ended by itself, which is counted; interrupts by the user are not.

    Returns:
        The number of the queued trial, None where its process has ended too often.
    """
    deaths = trial.user_attrs.get(DEATHS, 0) + died
    if deaths > DEATHS_FORGIVEN:
        return None
    again = copy.deepcopy(trial)
    again.user_attrs = {k: v for k, v in trial.user_attrs.items() if k not in (PROCESS, REASON, RUN)}
    again.user_attrs[DEATHS] = deaths
    known = {t.number for t in study.get_trials(deepcopy=False)}
    RetryHeartbeatStaleTrialCallback()(study, again)
    for queued in study.get_trials(deepcopy=False):
        if queued.number not in known and queued.system_attrs.get("retry_history", [])[-1:] == [trial.number]:
            return queued.number
    return None


def _fell_silent(tracking: str, study: Study, trial: FrozenTrial) -> None:
    """Queue a trial again that Optuna has failed because its heartbeats stopped, on any machine."""
    _tell(trial.number, "fell silent", queue_again(study, trial, died=True))
    close_run(MlflowClient(tracking), trial.user_attrs.get(RUN), "its process fell silent")


def _tell(number: int, what: str, queued: int | None) -> None:
    end = "it is given up" if queued is None else f"it is run again as trial {queued}"
    print(f"the process of trial {number} {what}; {end}", file=sys.stderr, flush=True)


def recover(study: Study, storage: PatientStorage, client: MlflowClient) -> set[int]:
    """Fail the trials of this machine whose process is gone, without waiting for its heartbeats to be missed, and
    those of any machine whose heartbeats have stopped; queue them again.

    The caller keeps others out (`alone`): a trial under way that no process calls its own is then one whose process
    ended as it took the trial.

    Returns:
        The numbers of this machine's trials that were queued again.
    """
    queued = set()
    for trial in study.get_trials(states=(TrialState.RUNNING,)):
        process = trial.user_attrs.get(PROCESS)
        if process is not None and not has_died(process):
            continue
        try:
            storage.set_trial_user_attr(trial._trial_id, REASON, "its process died")
            storage.set_trial_state_values(trial._trial_id, TrialState.FAIL)
        except UpdateFinishedTrialError:
            continue  # it ended in this moment
        number = queue_again(study, trial, died=True)
        _tell(trial.number, "died", number)
        if number is not None:
            queued.add(trial.number)
        close_run(client, trial.user_attrs.get(RUN), "its process died")
    fail_stale_trials(study)
    return queued
