"""Optuna's study: its sampler and pruner, and the trials that wait in it."""

from __future__ import annotations

import copy
import json
import sys
from collections.abc import Mapping
from functools import partial
from importlib.util import find_spec
from typing import TypeVar

import optuna
from mlflow import MlflowClient
from optuna import Study, pruners, samplers
from optuna.exceptions import UpdateFinishedTrialError
from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback, fail_stale_trials
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState

from lightning_pose.errors import ConfigError
from lightning_pose.runs.process import has_died
from lightning_pose.runs.tags import PROCESS, REASON, RUN
from lightning_pose.sweeps.parent_run import close_run
from lightning_pose.sweeps.plan import Plan
from lightning_pose.sweeps.space import Config, Settings, list_grid, suggest_name
from lightning_pose.sweeps.storage import connect_storage, lock_study

__all__ = [
    "SAMPLERS",
    "count_waiting",
    "enqueue_grid",
    "is_grid",
    "load_study",
    "open_storage",
    "open_study",
    "queue_again",
    "recover_trials",
]

T = TypeVar("T")

DEATHS_FORGIVEN = 3
DEATHS = "deaths"
"""User attribute of a trial: how many times its process has died, counted across the trials that queued it again."""
GRID_POINT = "grid_cell"
"""User attribute of a trial: its grid point, as JSON."""
SEEDS = "samplers"
"""User attribute of a study: how many samplers have been seeded."""

SAMPLERS: dict[str, type[samplers.BaseSampler]] = {
    "tpe": samplers.TPESampler,
    "gp": samplers.GPSampler,
    "random": samplers.RandomSampler,
    "grid": samplers.RandomSampler,  # never used: its points wait in the study
    "cmaes": samplers.CmaEsSampler,
    "nsga2": samplers.NSGAIISampler,
    "nsga3": samplers.NSGAIIISampler,
    "qmc": samplers.QMCSampler,
}
SYNONYMS = {"nsgaii": "nsga2", "nsgaiii": "nsga3", "sobol": "qmc"}
PRUNERS: dict[str, type[pruners.BasePruner]] = {
    "none": pruners.NopPruner,
    "median": pruners.MedianPruner,
    "percentile": pruners.PercentilePruner,
    "hyperband": pruners.HyperbandPruner,
    "halving": pruners.SuccessiveHalvingPruner,
    "threshold": pruners.ThresholdPruner,
}


def is_grid(plan: Plan) -> bool:
    """Whether the sweep runs every combination once."""
    return _normalize_name(plan.sampler["name"]) == "grid"


def open_storage(url: str, tracking: str) -> RDBStorage:
    """Connect to Optuna's database; a trial whose process sends no heartbeat is failed and queued again.

    Args:
        url: of the database.
        tracking: MLflow's address, where the trials' runs are.

    Raises:
        ConfigError: the database cannot be reached or read.
    """
    return connect_storage(url, partial(_requeue_stale, tracking))


def open_study(plan: Plan, name: str, storage: RDBStorage) -> Study:
    """Create the study, or go on with it.

    Raises:
        ConfigError: the sampler or pruner is unknown or does not suit, or a study of this name has another search.
    """
    _build_sampler(plan, plan.seed)  # before a study is created that cannot be run
    _build_pruner(plan)
    if is_grid(plan):
        list_grid(plan.space)
    if name in optuna.get_all_study_names(storage):
        study = optuna.load_study(study_name=name, storage=storage)
        for what, text in plan.describe().items():
            if study.user_attrs.get(what) != text:
                raise ConfigError(
                    f"the study {name} exists with another {what}; give this one a name of its own with --study, or "
                    "undo the change"
                )
        return study
    directions = [StudyDirection.MAXIMIZE if o.maximize else StudyDirection.MINIMIZE for o in plan.objectives]
    study = optuna.create_study(study_name=name, storage=storage, directions=directions)
    for what, text in plan.describe().items():
        study.set_user_attr(what, text)
    study.set_metric_names([objective.metric for objective in plan.objectives])
    return study


def load_study(plan: Plan, name: str, storage: RDBStorage) -> Study:
    """The study for one worker, with a sampler of a seed that no other worker and no other command has."""
    study = optuna.load_study(study_name=name, storage=storage)
    with lock_study(storage, name):
        number = study.user_attrs.get(SEEDS, 0)
        study.set_user_attr(SEEDS, number + 1)
    study.sampler = _build_sampler(plan, plan.seed + number)
    study.pruner = _build_pruner(plan)
    return study


def _normalize_name(name: str) -> str:
    plain = name.lower().replace("-", "").replace("_", "").replace("successive", "")
    return SYNONYMS.get(plain, plain)


def _build_sampler(plan: Plan, seed: int) -> samplers.BaseSampler:
    name = _normalize_name(plan.sampler["name"])
    if name == "cmaes" and len(plan.objectives) > 1:
        raise ConfigError("sampler cmaes is for one objective; take nsga2 or tpe for several")
    if name == "cmaes" and find_spec("cmaes") is None:  # Optuna would find out in the middle of the sweep
        raise ConfigError("sampler cmaes needs the package cmaes; `uv sync --extra sweep` installs it, or take tpe")
    # The points of qmc are one sequence, which the study counts for all workers.
    options: Config = {"seed": plan.seed if name == "qmc" else seed}
    if name == "tpe":
        options["constant_liar"] = True  # workers keep away from what others are trying
    if name == "cmaes":
        options["warn_independent_sampling"] = False
    return _build_named("sampler", name, SAMPLERS, options, plan.sampler)


def _build_pruner(plan: Plan) -> pruners.BasePruner:
    name = _normalize_name(plan.pruner["name"])
    comparable = len(plan.objectives) == 1 and plan.objectives[0].metric.startswith("val/")
    if name == "default":
        name = "median" if comparable else "none"
    if name in PRUNERS and name != "none" and not comparable:
        raise ConfigError(f"pruner {name} needs one objective of validation frames; take pruner none")
    options: Config = {"percentile": 25.0} if name == "percentile" else {}
    return _build_named("pruner", name, PRUNERS, options, plan.pruner)


def _build_named(what: str, name: str, kinds: Mapping[str, type[T]], options: Settings, given: Settings) -> T:
    """Build a sampler or pruner with the file's options on top of the project's."""
    if name not in kinds:
        raise ConfigError(f"{what} {given['name']!r} is not known; {suggest_name(name, kinds)}")
    kind = kinds[name]
    try:
        return kind(**{**options, **{key: value for key, value in given.items() if key != "name"}})
    except ImportError as error:
        raise ConfigError(f"{what} {name} needs another package ({error.__cause__ or error}); install it") from error
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"{what} {name} does not take these options ({error}); see Optuna's {kind.__name__}"
        ) from error


def enqueue_grid(study: Study, plan: Plan) -> None:
    """Queue every grid point that is not in the study yet, in whatever state.

    The caller holds the lock (`lock_study`), or two commands would queue the same point.
    """
    there = {trial.user_attrs.get(GRID_POINT) for trial in study.get_trials(deepcopy=False)}
    for point in list_grid(plan.space, plan.seed):
        name = json.dumps(point, sort_keys=True)
        if name not in there:
            study.enqueue_trial(point, user_attrs={GRID_POINT: name})


def count_waiting(study: Study) -> int:
    """How many trials wait in the study."""
    return len(study.get_trials(deepcopy=False, states=(TrialState.WAITING,)))


def queue_again(study: Study, trial: FrozenTrial, lost: bool) -> int | None:
    """Queue a trial again that did not fail by itself, but not one that ends its process every time.

    Args:
        study: of the trial.
        trial: which has ended.
        lost: whether its process was lost, which is counted; interrupts by the user are not.

    Returns:
        The number of the queued trial, None where its process has ended too often.
    """
    deaths = trial.user_attrs.get(DEATHS, 0) + lost
    if deaths > DEATHS_FORGIVEN:
        return None
    again = copy.deepcopy(trial)
    again.user_attrs = {k: v for k, v in trial.user_attrs.items() if k not in (PROCESS, REASON, RUN)} | {DEATHS: deaths}
    retry = RetryHeartbeatStaleTrialCallback()
    retry(study, again)
    return max(t.number for t in study.get_trials(deepcopy=False) if retry.retry_history(t)[-1:] == [trial.number])


def _requeue_stale(tracking: str, study: Study, trial: FrozenTrial) -> None:
    """Queue a trial again that Optuna has failed because it had no heartbeat, on any machine."""
    _report_lost(trial.number, "sent no heartbeat", queue_again(study, trial, lost=True))
    close_run(MlflowClient(tracking), trial.user_attrs.get(RUN), "its process sent no heartbeat")


def _report_lost(number: int, what: str, queued: int | None) -> None:
    end = "it is given up" if queued is None else f"it is run again as trial {queued}"
    print(f"the process of trial {number} {what}; {end}", file=sys.stderr, flush=True)


def recover_trials(study: Study, storage: RDBStorage, client: MlflowClient) -> tuple[int, int]:
    """Fail the trials of this machine whose process is gone, before their heartbeats are missed, and those of any
    machine without a recent heartbeat; queue them again.

    The caller holds the lock (`lock_study`): a running trial without a process name is then one whose process ended
    as it took the trial.

    Returns:
        How many of this machine's trials were queued again, and how many were given up.
    """
    queued = given_up = 0
    study_id = storage.get_study_id_from_name(study.study_name)
    for trial in study.get_trials(states=(TrialState.RUNNING,)):
        process = trial.user_attrs.get(PROCESS)
        if process is not None and not has_died(process):
            continue
        try:
            trial_id = storage.get_trial_id_from_study_id_trial_number(study_id, trial.number)
            storage.set_trial_user_attr(trial_id, REASON, "its process died")
            storage.set_trial_state_values(trial_id, TrialState.FAIL)
        except UpdateFinishedTrialError:
            continue  # it has just ended
        number = queue_again(study, trial, lost=True)
        _report_lost(trial.number, "died", number)
        queued, given_up = queued + (number is not None), given_up + (number is None)
        close_run(client, trial.user_attrs.get(RUN), "its process died")
    fail_stale_trials(study)
    return queued, given_up
