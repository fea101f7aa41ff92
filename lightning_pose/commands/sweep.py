"""The verb `sweep`: search a config's settings by a sweep file, on validation frames, resumable and in parallel."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

import yaml
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from lightning_pose.commands.parser import VerbParser
from lightning_pose.concurrency.tasks import SCHEDULER_HELP
from lightning_pose.errors import ConfigError

if TYPE_CHECKING:  # Optuna and Lightning take seconds, and `--help` does without
    from mlflow import MlflowClient
    from optuna import Study

    from lightning_pose.studies.figure_spec import FigureSpec
    from lightning_pose.sweeps.plan import Plan
    from lightning_pose.sweeps.workers import Job

__all__ = ["main", "parse_value"]

N_TRIALS = 20

HELP = """Search the settings of a config for what is best on its validation frames. Test frames choose nothing.

  a search                     sweep sweeps/surf_cnn.yaml --data.root DIR
  20 trials more               sweep sweeps/surf_cnn.yaml --data.root DIR --n_trials 20
  four at a time               ... --workers 4
  many machines, one study     ... --storage postgresql://USER:PASSWORD@HOST/DATABASE
  on a Dask cluster            ... --storage postgresql://... --scheduler tcp://HOST:8786
  change what is not searched  ... --trainer.max_epochs 10
  train and test the best      fit --config mlruns/sweeps/STUDY/best.yaml
  follow its progress          optuna-dashboard sqlite:///mlruns/optuna.db
                               mlflow ui --backend-store-uri sqlite:///mlruns/mlflow.db
  a figure of the thesis       sweep sweeps/thesis/figure_4_5.yaml --data.root DIR
  less of it                   ... --space.model.neighbours "[1, 10, 40]" --trainer.max_epochs 20

The same command goes on with the study, after Ctrl-C as after the last trial. A trial whose process is
killed is run again. Trials are runs nested in the study's, and keep no checkpoints."""

FILE_HELP = """a sweep file:

  base: ../configs/surf_cnn.yaml      # from this file's folder, the current one, or the repository
  objective: val/position_median_m    # or a list, such as [val/position_median_m, cost/parameters]; default val/loss,
                                      # or this where the losses of several base configs differ
  sampler: tpe                        # gp, random, grid, cmaes, nsga2, nsga3, qmc; or {name: tpe, n_startup_trials: 5}
  pruner: median                      # none, percentile, hyperband, halving, threshold
  n_trials: 30
  settings: {trainer.max_epochs: 10}  # for all trials, on top of the base config
  space:                              # names as on the command line of fit
    model.units: {type: int, low: 50, high: 300, step: 50}
    model.learning_rate: {type: float, low: 1.0e-4, high: 1.0e-2, log: true}
    model.schedule: [constant, cosine]
    model.weight_decay: {type: float, low: 0, high: 0.1, when: {model.schedule: cosine}}

a study, such as those of sweeps/thesis, is a sweep that ends in a figure and a table of all its trials:

  base: [../configs/node_pose.yaml, ../configs/graph_pose.yaml]   # `when: {base: node_pose}` is for one of them
  sampler: grid                       # every combination; test frames choose nothing
  measure: test                       # test frames too; or features, without training
  space: {model.neighbours: [1, 10, 40], seed_everything: [0, 1, 2]}   # seeds are averaged
  figure:
    x: model.neighbours
    y: [test/position_median_m]       # one panel each
    kind: line                        # bar, curve (a trial's own, by clip length), pictures (of keypoints)
    log: [x]
    beside: [retrieval_top1]          # baselines
    table: [test/position_median_m, cost/train_seconds]"""


def main(argv: list[str]) -> int:
    """Run the verb with the arguments after its name.

    Raises:
        ConfigError: the sweep file, an option or the study is refused; or no trial has a value.
        KeyboardInterrupt: Ctrl-C; the same command goes on.
    """
    own, overrides = _split_arguments(argv)
    args = _build_sweep_parser().parse_args(own)
    # Imported here, so that `--help` does not wait for them.
    from lightning_pose.concurrency.signals import delay_interrupts
    from lightning_pose.studies.figure_spec import parse_figure_spec
    from lightning_pose.sweeps.parent_run import close_parent, open_parent
    from lightning_pose.sweeps.plan import read_plan
    from lightning_pose.sweeps.storage import hide_password, lock_study
    from lightning_pose.sweeps.study import (
        count_waiting,
        enqueue_grid,
        is_grid,
        open_storage,
        open_study,
        recover_trials,
    )
    from lightning_pose.sweeps.workers import Job

    plan = read_plan(args.file, overrides)
    spec = parse_figure_spec(plan.figure, plan.measure, plan.space)  # checked before anything is trained
    name = args.study or f"{args.file.stem}-{plan.scene}"
    storage = open_storage(args.storage, plan.tracking[0])
    status, opened = "KILLED", None
    try:
        with lock_study(storage, name):
            study = open_study(plan, name, storage)
            with delay_interrupts():  # the run that it opens has to be closed
                client, parent = open_parent(study, plan)
                opened = client, parent, study
            recover_trials(study, storage, client)
            if is_grid(plan):
                enqueue_grid(study, plan)
        total = args.n_trials if args.n_trials is not None else plan.n_trials
        if is_grid(plan):
            total = min(count_waiting(study), math.inf if total is None else total)
        total = N_TRIALS if total is None else int(total)
        _run_trials(study, plan, Job(plan, name, args.storage, parent), total, args)
        client, parent = open_parent(study, plan)  # another one, if the user has deleted it meanwhile
        opened = client, parent, study
        _write_results(study, plan, spec, client, parent, args.out or Path("mlruns") / "sweeps" / name)
        status = "FINISHED"
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt("the same command goes on") from stop
    except Exception:
        status = "FAILED"
        raise
    finally:
        if opened is not None:
            close_parent(*opened, status)
    print(f"run {parent} in {plan.tracking[0]}\nstudy {name} in {hide_password(args.storage)}")
    return 0


def _run_trials(study: Study, plan: Plan, job: Job, total: int, args: argparse.Namespace) -> None:
    """Run the trials under a progress bar that shows the best value so far."""
    from lightning_pose.sweeps.results import describe_best
    from lightning_pose.sweeps.workers import run_here, run_in_processes, run_on_cluster

    console = Console(stderr=True)
    columns = (
        TextColumn("trial"), MofNCompleteColumn(), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
        TextColumn("{task.description}", markup=False),
    )  # fmt: skip
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(describe_best(study, plan), total=total)

        def show_end() -> None:
            text = describe_best(study, plan)
            bar.update(task, advance=1, description=text)
            if not console.is_terminal:
                print(f"trial {bar.tasks[0].completed:.0f}/{total}  {text}", file=sys.stderr, flush=True)

        if args.scheduler is not None:
            run_on_cluster(job, total, show_end, args.workers, args.scheduler)
        elif args.workers == 1 or total < 2:
            run_here(job, total, show_end)
        else:
            run_in_processes(job, total, show_end, args.workers)


def _write_results(
    study: Study, plan: Plan, spec: FigureSpec | None, client: MlflowClient, parent: str, folder: Path
) -> None:
    """Print the best trials; write their config and the figures to a folder and to the study's run.

    Raises:
        ConfigError: no trial has a value, or the figure shows what no trial has measured.
    """
    from lightning_pose.runs.tags import REASON
    from lightning_pose.studies.result import write_study
    from lightning_pose.sweeps.parent_run import describe_parent
    from lightning_pose.sweeps.results import best_trial, build_sheet, count_states, draw_figures, write_best

    best = best_trial(study, plan)
    if best is None:
        trials = study.get_trials(deepcopy=False)
        reasons = [trial.user_attrs[REASON] for trial in trials if REASON in trial.user_attrs]
        why = "other commands run it; wait for them" if trials else "give --n_trials 1 or more"
        if reasons:
            why = f"the last: {reasons[-1]}"
        raise ConfigError(
            f"no trial of {study.study_name} has ended with a value ({count_states(study) or 'none ran'}); {why}"
        )
    folder.mkdir(parents=True, exist_ok=True)
    config = None
    if plan.comparable:  # before what may fail
        config = write_best(best, study, plan, folder)
        client.log_artifact(parent, str(config))
        client.set_tag(parent, "sweep.best_trial", str(best.number))
        for objective, value in zip(plan.objectives, best.values, strict=True):
            client.log_metric(parent, f"best/{objective.metric}", value)
    describe_parent(client, parent, study, plan)
    if plan.measure is None or spec is None:
        build_sheet(study, plan).show()
    if plan.measure is None:  # other studies have a figure of their own only
        for file in draw_figures(study, plan, folder):
            client.log_artifact(parent, str(file), "figures")
    if spec is not None:
        files, table = write_study(study, plan, spec, folder)
        for file in files:
            client.log_artifact(parent, str(file), "study")
        table.show()
    print(f"{count_states(study)}\nfigures and tables in {folder}")
    if config is not None:
        print(f"the best on validation frames: python -m lightning_pose fit --config {config}")


def _split_arguments(argv: list[str]) -> tuple[list[str], dict[str, object]]:
    """The verb's own arguments, and the settings of the config, whose names have dots."""
    own: list[str] = []
    overrides: dict[str, object] = {}
    words = iter(argv)
    for word in words:
        name, equals, value = word.removeprefix("--").partition("=")
        if not word.startswith("--") or ("." not in name and name != "seed_everything"):
            own.append(word)
            continue
        if name.endswith("+"):
            raise ConfigError(f"{word} adds to a list, which a sweep cannot; put the whole list into the base config")
        text = value if equals else next(words, None)
        if text is None:
            raise ConfigError(f"{word} has no value; give one")
        overrides[name.replace(".init_args.", ".")] = parse_value(text)
    return own, overrides


def parse_value(text: str) -> object:
    """A setting's value as YAML has it; a date or a number such as 00 is text, because it is a folder's name."""
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        return text
    misread = isinstance(value, date) or (type(value) is int and str(value) != text.strip())
    return text if misread else value


def _build_sweep_parser() -> VerbParser:
    parser = VerbParser(
        "sweep",
        usage="python -m lightning_pose sweep FILE [--n_trials N] [--workers W] [--SETTING VALUE ...]",
        description=HELP,
        epilog=FILE_HELP,
    )
    parser.add_argument("file", metavar="FILE", type=Path, help="sweep file, such as sweeps/surf_cnn.yaml")
    parser.add_argument(
        "--n_trials", type=_parse_count(0), metavar="N", help="this many more (default: the file's, or 20)"
    )
    parser.add_argument("--workers", type=_parse_count(1), metavar="W", default=1, help="processes (default: 1)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help=SCHEDULER_HELP)
    parser.add_argument("--storage", metavar="URL", default="sqlite:///mlruns/optuna.db", help="default: %(default)s")
    parser.add_argument("--study", metavar="NAME", help="default: the file's name and the scene's")
    parser.add_argument("--out", metavar="DIR", type=Path, help="default: mlruns/sweeps/STUDY")
    return parser


def _parse_count(least: int) -> Callable[[str], int]:
    """A parser of whole numbers from `least` on, for argparse."""

    def whole(text: str) -> int:
        if not text.isdigit() or int(text) < least:
            raise argparse.ArgumentTypeError(f"is {text}, give {least} or more")
        return int(text)

    return whole
