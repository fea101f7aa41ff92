"""The verb `report`: finished runs as a table of systems by scenes, out of the MLflow store, in a moment."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from lightning_pose.commands.parser import VerbParser
from lightning_pose.errors import ConfigError
from lightning_pose.metrics.catalog import reference_baseline
from lightning_pose.paths import default_tracking_uri
from lightning_pose.reports.choose_run import PICKS

if TYPE_CHECKING:
    from lightning_pose.reports.table import Report

__all__ = ["main"]

FORMATS = {"table": ".txt", "markdown": ".md", "latex": ".tex", "csv": ".csv", "json": ".json"}

HELP = """A table of systems (rows) by scenes (columns), median position error in metres / median orientation error in
degrees on the test frames, and the mean over the scenes of each dataset, out of the runs that `fit` and `test` have
left in MLflow.

  everything               report
  beside published rows    report --published --baselines
  one chapter's rows       report --published --chapter 4
  a paper's table          report --scene redkitchen --format latex --out table.tex
  what it costs            report --costs --skill
  a row for each setting   report --system NodePose --by model.neighbours --by model.conv
  mean and std of seeds    report --pick spread --by features
  only some runs           report --tag model.neighbours=20 --tag split=official --since 2026-03-01
  into pandas              report --format csv --out runs.csv
  with all its settings    report --format json | jq '.rows[].cells'
  another store            report --tracking_uri postgresql://USER:PASSWORD@HOST/mlflow"""

RULES = """Several runs of a system on a scene are joined by --pick:

  best     the run with the lowest validation error (val/position_median_m, else val/loss, of its best epoch, or of its
           last where it lacks that). Test errors never choose. Where no run has one, the newest.
  latest   the newest run
  spread   mean and standard deviation over runs that differ in nothing but seed_everything (and in the folder of the
           same data); others are refused, or get rows of their own with --by NAME

Runs of a scene must agree in what they were tested on: task (absolute poses of images, or relative poses of clips),
dataset, split, ground_truth, unit, image_size, test_frames, and for clips clip_length, stride and relative_frame.
Where they do not, nothing is shown until one is chosen, as in --tag task=absolute. --tag and --by take the names of
tags (features, split, task, git_commit) and of settings as fit has them (model.units, data.extractor.n_features,
seed_everything). Only finished runs count, and trials of sweeps only with --trials.

CSV is tidy, a line a system and scene, and one a mean; its notes, as those of LaTeX, go to standard error."""


def main(argv: list[str]) -> int:
    """Run the verb with the arguments after its name.

    Raises:
        ConfigError: an option does not do, there is no store, no run is left, or runs do not compare.
    """
    args = _build_report_parser().parse_args(argv)
    # Only now, so that `--help` is there at once.
    from lightning_pose.reports.baseline_rows import add_baselines
    from lightning_pose.reports.filters import select_runs
    from lightning_pose.reports.published_rows import add_published
    from lightning_pose.reports.table import build_report
    from lightning_pose.runs.reader import read_runs

    if args.chapter and not args.published:
        raise ConfigError("--chapter chooses among published rows; give --published as well")
    form = args.format or _choose_format(args.out)
    uri = args.tracking_uri or default_tracking_uri()
    runs, notes = select_runs(
        read_runs(uri),
        experiments=[args.experiment] if args.experiment else [],
        systems=args.system,
        scenes=args.scene,
        tags=[_split_tag(text) for text in args.tag],
        since=args.since,
        until=args.until,
        trials=args.trials,
    )
    report = build_report(runs, args.pick, tuple(dict.fromkeys(args.by)))
    report.notes += notes
    if args.baselines:
        add_baselines(report)
    if args.published:
        add_published(report, args.chapter)
    report.further = tuple(name for name in ("skill", "costs") if getattr(args, name))
    if args.skill:
        images, clips = reference_baseline(clips=False), reference_baseline(clips=True)
        report.notes.append(f"skill is model error over that of {images} ({clips} for clips); below 1, learning helped")
    if report.further and len(report.scenes) > 1:
        report.notes.append("skill and costs are means over the scenes of a row")
    _write_report(report, form, args.out)
    return 0


def _write_report(report: Report, form: str, out: Path | None) -> None:
    from lightning_pose.reports.data_formats import as_csv, as_json
    from lightning_pose.reports.text_formats import as_latex, as_markdown, print_table

    writers = {"markdown": as_markdown, "latex": as_latex, "csv": as_csv, "json": as_json}
    for note in (*report.notes, *report.footnotes) if form in ("csv", "latex") else ():
        print(f"note: {note}", file=sys.stderr)
    try:
        if out is not None:
            out.parent.mkdir(parents=True, exist_ok=True)
        with nullcontext(sys.stdout) if out is None else out.open("w", encoding="utf-8") as file:
            if form == "table":
                print_table(report, file)
            else:
                print(writers[form](report), file=file)
    except OSError as error:
        if out is None:
            raise
        raise ConfigError(f"--out {out} cannot be written ({error.strerror}); give a file's name") from error
    if out is not None:
        print(out, file=sys.stderr)


def _choose_format(out: Path | None) -> str:
    """The format that a file's name asks for; a table otherwise."""
    return next((form for form, suffix in FORMATS.items() if out is not None and out.suffix == suffix), "table")


def _split_tag(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise ConfigError(f"--tag {text} has no value; give NAME=VALUE, such as split=official or model.units=100")
    return name, value


def _build_report_parser() -> VerbParser:
    parser = VerbParser(
        "report",
        usage="python -m lightning_pose report [--format FORMAT] [--scene NAME ...] [--by NAME ...] [--published] ...",
        description=HELP,
        epilog=RULES,
    )
    add = parser.add_argument
    add_several = partial(parser.add_argument, action="append", default=[])
    add("--format", choices=FORMATS, help="default: what --out ends with (.md .tex .csv .json), or table")
    add("--out", metavar="FILE", type=Path, help="write it there")
    add(
        "--tracking_uri",
        metavar="URI",
        help="MLflow store (default: MLFLOW_TRACKING_URI, or sqlite:///mlruns/mlflow.db)",
    )
    add("--pick", choices=PICKS, default="best", help="how runs of one cell are joined (default: %(default)s)")
    add_several("--by", metavar="NAME", help="a row for each value of a setting (repeatable)")
    add("--experiment", metavar="NAME", help="only this MLflow experiment")
    add_several("--system", metavar="NAME", help="only this architecture (repeatable)")
    add_several("--scene", metavar="NAME", help="only this scene (repeatable)")
    add_several(
        "--tag",
        metavar="NAME=VALUE",
        help="only runs with this tag or setting, such as data.extractor.backbone=resnet50 (repeatable; values of one "
        "name are alternatives)",
    )
    add("--since", metavar="DATE", help="only runs that started then or later: 2026-03-01, 2026-03-01T18:00")
    add("--until", metavar="DATE", help="only runs that started before the end of that day, or that time")
    add("--trials", action="store_true", help="runs of sweeps as well")
    add("--baselines", action="store_true", help="rows of the baselines of the runs on show, by their features")
    add("--skill", action="store_true", help="a column: model error over that of retrieval")
    add("--costs", action="store_true", help="columns: parameters, seconds of training, ms and bytes a frame")
    add("--published", action="store_true", help="rows of published tables for the scenes on show, marked as such")
    add_several(
        "--chapter",
        metavar="2..6",
        type=int,
        choices=range(2, 7),
        help="only published rows of this chapter of the thesis (repeatable)",
    )
    return parser
