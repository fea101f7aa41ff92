"""What a sweep leaves: the best config, figures, a table of the best trials, and a study's own figure and table."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml
from optuna import Study
from optuna.trial import FrozenTrial, TrialState

from lightning_pose.runs.tags import REASON
from lightning_pose.sweeps.plan import Objective, Plan
from lightning_pose.terminal import Sheet

__all__ = ["SHOWN", "best_trial", "best_trials", "completed", "draw_figures", "sheet", "short", "tally", "write_best"]

SHOWN = 10


def completed(study: Study) -> list[FrozenTrial]:
    """Trials with a value, in order."""
    return study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))


def best_trials(study: Study, plan: Plan) -> list[FrozenTrial]:
    """The best first: by value, or for several objectives those that none beats in all, by the first objective."""
    found = completed(study) if len(plan.objectives) == 1 else study.best_trials
    return sorted(found, key=lambda trial: trial.values[0], reverse=plan.objectives[0].maximize)


def best_trial(study: Study, plan: Plan) -> FrozenTrial | None:
    """The best by the first objective; None where no trial has ended with a value."""
    return next(iter(best_trials(study, plan)), None)


def tally(study: Study) -> str:
    """How many trials ended how, as `5 complete, 1 pruned`."""
    states = [trial.state.name.lower() for trial in study.get_trials(deepcopy=False)]
    return ", ".join(f"{states.count(name)} {name}" for name in dict.fromkeys(sorted(states)))


def write_best(trial: FrozenTrial, study: Study, plan: Plan, folder: Path) -> Path:
    """Write `best.yaml`, which `fit --config` takes."""
    values = {p.key: p.value(trial.params[p.key]) for p in plan.space if p.key in trial.params}
    reached = ", ".join(f"{o.metric} {v:.6g}" for o, v in zip(plan.objectives, trial.values, strict=True))
    base = plan.base(values).name
    head = f"# Trial {trial.number} of the sweep {study.study_name} of {base}: {reached}.\n"
    file = folder / "best.yaml"
    file.write_text(head + yaml.safe_dump(plan.config(values), sort_keys=False))
    return file


def sheet(study: Study, plan: Plan) -> Sheet:
    """The best trials, and why the last ones that broke did."""
    several = len(plan.objectives) > 1
    keys = [parameter.key for parameter in plan.space]
    heads = ["trial", *(objective.metric for objective in plan.objectives), *_last_names(keys)]
    rows = []
    for trial in best_trials(study, plan)[:SHOWN]:
        params = [short(trial.params.get(key, "")) for key in keys]
        rows.append([str(trial.number), *(f"{value:.4g}" for value in trial.values), *params])
    failed = [t for t in study.get_trials(deepcopy=False, states=(TrialState.FAIL,)) if REASON in t.user_attrs]
    caption = f"trial {failed[-1].number} failed: {failed[-1].user_attrs[REASON]}" if failed else None
    return Sheet(f"{study.study_name}: {'Pareto front' if several else 'best trials'}", heads, rows, caption)


def _last_names(keys: list[str]) -> list[str]:
    """Keys without what they are in, where that leaves them apart: a terminal is narrow."""
    last = [key.rpartition(".")[2] for key in keys]
    return [name if last.count(name) == 1 else key for name, key in zip(last, keys, strict=True)]


def short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def draw_figures(study: Study, plan: Plan, folder: Path) -> list[Path]:
    """Draw what can be drawn of the completed trials, as PNG files.

    Importance needs two trials that differ, a Pareto front two objectives; what cannot be computed is left out.
    """
    import matplotlib.pyplot as plt

    plt.switch_backend("Agg")  # no display is needed
    files = []
    for name, draw in _figures(study, plan):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Optuna warns that these are experimental
            try:
                drawn = draw()
            except (ValueError, RuntimeError, ImportError):
                plt.close("all")
                continue
        axes = drawn.flat[0] if hasattr(drawn, "flat") else drawn
        file = folder / f"{name}.png"
        axes.figure.savefig(file, dpi=120, bbox_inches="tight")
        plt.close("all")
        files.append(file)
    return files


def _figures(study: Study, plan: Plan) -> Iterator[tuple[str, Callable[[], Any]]]:
    from optuna.visualization import matplotlib as draw

    done = completed(study)
    for i, objective in enumerate(plan.objectives):
        named: dict[str, Any] = {"target_name": objective.metric}
        weighed = named
        if len(plan.objectives) > 1:  # with one, Optuna knows which way is better, and draws the best so far
            named = named | {"target": lambda trial, i=i: trial.values[i]}
            sign = -1 if objective.maximize else 1  # what matters for the best trials, which it takes for the lowest
            weighed = named | {"target": lambda trial, i=i, sign=sign: sign * trial.values[i]}
        end = f"_{_file_name(objective)}" if len(plan.objectives) > 1 else ""
        yield f"history{end}", lambda named=named: draw.plot_optimization_history(study, **named)
        yield f"slice{end}", lambda named=named: draw.plot_slice(study, **named)
        yield f"parallel_coordinate{end}", lambda named=named: draw.plot_parallel_coordinate(study, **named)
        if len({trial.values[i] for trial in done}) > 1:
            yield f"importance{end}", lambda named=weighed: draw.plot_param_importances(study, **named)
    if len(plan.objectives) in (2, 3):
        names = [objective.metric for objective in plan.objectives]
        yield "pareto_front", lambda: draw.plot_pareto_front(study, target_names=names)


def _file_name(objective: Objective) -> str:
    return objective.metric.replace("/", "_")
