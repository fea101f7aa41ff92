"""Which runs a report is about: filters, and errors that say what there is."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime, timedelta

from lightning_pose.errors import ConfigError
from lightning_pose.metrics.catalog import MEDIANS
from lightning_pose.runs.reader import Run

__all__ = ["check_setting", "read_date", "select_runs"]

MOST = 12  # values that a message lists


def select_runs(
    runs: Sequence[Run],
    *,
    experiments: Sequence[str] = (),
    systems: Sequence[str] = (),
    scenes: Sequence[str] = (),
    tags: Sequence[tuple[str, str]] = (),
    since: str | None = None,
    until: str | None = None,
    trials: bool = False,
) -> tuple[list[Run], list[str]]:
    """The runs that pass all filters and have been tested, in their order; by default every run that no sweep made.

    Args:
        runs: to choose from.
        experiments: names of MLflow experiments.
        systems: architectures.
        scenes: names of scenes.
        tags: (name, value) of tags or settings; values of one name are alternatives.
        since: when they started, at the earliest: an ISO date or time.
        until: when they started, before this time or the end of this day.
        trials: runs of sweeps as well.

    Returns:
        The runs, and notes on what was left out.

    Raises:
        ConfigError: nothing passes; the message names the filter and the values that exist.
    """
    kept = [run for run in runs if trials or not run.trial]
    if not kept:
        raise ConfigError(f"all {len(runs)} finished runs are trials of sweeps; give --trials, or train with `fit`")
    kept = _keep_values(kept, "--experiment ", experiments, lambda run: run.experiment)
    kept = _keep_values(kept, "--system ", systems, lambda run: run.system)
    kept = _keep_values(kept, "--scene ", scenes, lambda run: run.scene)
    for name in dict.fromkeys(name for name, _ in tags):
        check_setting(name, kept)
        wanted = [value for other, value in tags if other == name]
        kept = _keep_values(kept, f"--tag {name}=", wanted, lambda run, name=name: run.settings.get(name))
    kept = _keep_dates(kept, since, until)
    tested = [run for run in kept if f"test/{MEDIANS[0]}" in run.metrics]
    if not tested:
        why = " (trials of a sweep never see test frames)" if any(run.trial for run in kept) else ""
        raise ConfigError(
            f"none of the {len(kept)} runs has test errors{why}; "
            "measure a checkpoint with `python -m lightning_pose test --ckpt_path CKPT`"
        )
    missing = len(kept) - len(tested)
    note = f"{missing} of {len(kept)} runs have no test errors, as most trials of sweeps: left out"
    return tested, [note] if missing else []


def check_setting(name: str, runs: Iterable[Run]) -> None:
    """Refuse the name of a setting that no run has.

    Raises:
        ConfigError: with names that are near.
    """
    known = sorted({known for run in runs for known in run.settings})
    if name in known:
        return
    near = [other for other in known if other.rpartition(".")[2] == name] or difflib.get_close_matches(name, known, 3)
    hint = f"did you mean {' or '.join(near)}?" if near else "settings are named as on the command line of fit"
    raise ConfigError(f"no run has {name!r}, neither as a tag nor as a setting; {hint}")


def read_date(text: str, end: bool = False) -> float:
    """The milliseconds since 1970, as MLflow counts them, of an ISO date or time; local time unless it names a zone.

    Args:
        text: such as `2026-03-01` or `2026-03-01T18:00`.
        end: of a whole day, its end.

    Raises:
        ConfigError: it is neither, or is outside the range of dates.
    """
    try:
        date = datetime.fromisoformat(text)
    except ValueError:
        raise ConfigError(f"{text!r} is no date; give one as 2026-03-01 or 2026-03-01T18:00") from None
    whole_day = len(text) <= len("2026-03-01") and "T" not in text
    try:
        return (date + timedelta(days=1) if end and whole_day else date).astimezone().timestamp() * 1e3
    except (ValueError, OverflowError, OSError):  # which of them depends on the system
        raise ConfigError(f"{text!r} is out of range; give a date such as 2026-03-01") from None


def _keep_values(runs: list[Run], option: str, wanted: Sequence[str], read: Callable[[Run], str | None]) -> list[Run]:
    """The runs whose value is one of those wanted; all where nothing is."""
    values = sorted({value for run in runs if (value := read(run)) is not None})
    for value in wanted:
        if value not in values:
            more = f" and {len(values) - MOST} more" if len(values) > MOST else ""
            listed = ", ".join(values[:MOST]) or "none"
            raise ConfigError(f"{option}{value} matches no run; there is {listed}{more}")
    return [run for run in runs if read(run) in wanted] if wanted else runs


def _keep_dates(runs: list[Run], since: str | None, until: str | None) -> list[Run]:
    low = read_date(since) if since else float("-inf")
    high = read_date(until, end=True) if until else float("inf")
    kept = [run for run in runs if low <= run.started < high]
    if not kept:
        ends = (end(run.started for run in runs) / 1e3 for end in (min, max))
        first, last = (datetime.fromtimestamp(seconds).isoformat(" ", "minutes") for seconds in ends)
        options = " ".join(f"{name} {date}" for name, date in (("--since", since), ("--until", until)) if date)
        raise ConfigError(f"{options} matches no run; the {len(runs)} others are from {first} to {last}")
    return kept
