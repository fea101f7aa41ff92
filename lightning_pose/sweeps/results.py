"""The results of a sweep: its best trials, the best config, and Optuna's figures."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml
from optuna import Study
from optuna.trial import FrozenTrial, TrialState

from lightning_pose.runs.tags import REASON
from lightning_pose.sweeps.plan import Objective, Plan
from lightning_pose.sweeps.space import Config
from lightning_pose.terminal import Sheet

__all__ = [
    "SHOWN",
    "best_trial",
    "best_trials",
    "build_sheet",
    "count_states",
    "describe_best",
    "draw_figures",
    "format_value",
    "plan_figures",
    "write_best",
]

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    Drawn = Axes | np.ndarray
    """What Optuna's figures return: one axes, or an array of them."""

SHOWN = 10


def best_trials(study: Study, plan: Plan) -> list[FrozenTrial]:
    """Completed trials, the best first; for several objectives the Pareto front, by the first objective."""
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    found = complete if len(plan.objectives) == 1 else study.best_trials
    return sorted(found, key=lambda trial: trial.values[0], reverse=plan.objectives[0].maximize)


def best_trial(study: Study, plan: Plan) -> FrozenTrial | None:
    """The best by the first objective; None where no trial has ended with a value."""
    return next(iter(best_trials(study, plan)), None)


def describe_best(study: Study, plan: Plan) -> str:
    """The best trial so far in words; empty where trials cannot be compared."""
    best = best_trial(study, plan)
    if best is None or not plan.comparable:
        return "no value yet" if plan.comparable else ""
    pairs = zip(plan.objectives, best.values, strict=True)
    return "best " + ", ".join(f"{o.metric} {value:.4g}" for o, value in pairs) + f" (trial {best.number})"


def count_states(study: Study) -> str:
    """How many trials ended how, as `5 complete, 1 pruned`."""
    states = Counter(trial.state.name.lower() for trial in study.get_trials(deepcopy=False))
    return ", ".join(f"{number} {state}" for state, number in sorted(states.items()))


def write_best(trial: FrozenTrial, study: Study, plan: Plan, folder: Path) -> Path:
    """Write `best.yaml`, which `fit --config` takes."""
    values = {p.key: p.value(trial.params[p.key]) for p in plan.space if p.key in trial.params}
    reached = ", ".join(f"{o.metric} {v:.6g}" for o, v in zip(plan.objectives, trial.values, strict=True))
    base = plan.base(values).name
    head = f"# Trial {trial.number} of the sweep {study.study_name} of {base}: {reached}.\n"
    file = folder / "best.yaml"
    file.write_text(head + yaml.safe_dump(plan.config(values), sort_keys=False))
    return file


def build_sheet(study: Study, plan: Plan) -> Sheet:
    """A table of the best trials, with the reason of the last failure below it."""
    several = len(plan.objectives) > 1
    keys = [parameter.key for parameter in plan.space]
    heads = ["trial", *(objective.metric for objective in plan.objectives), *_last_names(keys)]
    rows = []
    for trial in best_trials(study, plan)[:SHOWN]:
        params = [format_value(trial.params.get(key, "")) for key in keys]
        rows.append([str(trial.number), *(f"{value:.4g}" for value in trial.values), *params])
    failed = [t for t in study.get_trials(deepcopy=False, states=(TrialState.FAIL,)) if REASON in t.user_attrs]
    caption = f"trial {failed[-1].number} failed: {failed[-1].user_attrs[REASON]}" if failed else None
    return Sheet(f"{study.study_name}: {'Pareto front' if several else 'best trials'}", heads, rows, caption)


def _last_names(keys: list[str]) -> list[str]:
    """The last part of each key where it is unique, else the whole key: a terminal is narrow."""
    last = [key.rpartition(".")[2] for key in keys]
    return [name if last.count(name) == 1 else key for name, key in zip(last, keys, strict=True)]


def format_value(value: object) -> str:
    """A number in four digits, anything else as it is."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def draw_figures(study: Study, plan: Plan, folder: Path) -> list[Path]:
    """Draw what can be drawn of the completed trials, as PNG files.

    Importance needs two trials that differ, a Pareto front two objectives; what cannot be computed is left out.
    """
    import matplotlib.pyplot as plt

    plt.switch_backend("Agg")  # no display is needed
    files = []
    for name, draw in plan_figures(study, plan.objectives):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Optuna warns that these are experimental
            try:
                drawn = draw()
            except (ValueError, RuntimeError, ImportError):
                plt.close("all")
                continue
        axes = drawn.flat[0] if isinstance(drawn, np.ndarray) else drawn
        file = folder / f"{name}.png"
        figure = axes.get_figure(root=True)
        assert figure is not None, "Optuna draws into one"
        figure.savefig(file, dpi=120, bbox_inches="tight")
        plt.close("all")
        files.append(file)
    return files


def plan_figures(study: Study, objectives: Sequence[Objective]) -> Iterator[tuple[str, Callable[[], Drawn]]]:
    """Optuna's figures of a study: the name of each, and a function that draws it."""
    from optuna.visualization import matplotlib as draw

    kinds: dict[str, Callable[..., Drawn]] = {
        "history": draw.plot_optimization_history,
        "slice": draw.plot_slice,
        "parallel_coordinate": draw.plot_parallel_coordinate,
        "importance": draw.plot_param_importances,
    }
    for i, objective in enumerate(objectives):
        values = {trial.values[i] for trial in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))}
        for name, draw_kind in kinds.items():
            options: Config = {"target_name": objective.metric}
            if len(objectives) > 1:  # for one, Optuna takes the direction of the study, and draws the best so far
                # Importance is that for the lowest targets.
                sign = -1 if name == "importance" and objective.maximize else 1
                options["target"] = lambda trial, i=i, sign=sign: sign * trial.values[i]
                name = f"{name}_{objective.metric.replace('/', '_')}"
            if not name.startswith("importance") or len(values) > 1:
                yield name, partial(draw_kind, study, **options)
    if len(objectives) in (2, 3):
        yield "pareto_front", partial(draw.plot_pareto_front, study, target_names=[o.metric for o in objectives])
