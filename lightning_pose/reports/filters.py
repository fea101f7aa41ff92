"""Which runs a report is about: filters, and errors that say what there is."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import NamedTuple

from lightning_pose.errors import ConfigError
from lightning_pose.runs.reader import Run

__all__ = ["Date", "Filters", "check_setting", "read_date", "select_runs", "setting"]

MOST = 12


class Date(NamedTuple):
    """A moment, in milliseconds since 1970 as MLflow counts them, and the text that the user gave for it."""

    text: str
    milliseconds: float


@dataclass(frozen=True)
class Filters:
    """What the runs must be; nothing is asked by default, but that no sweep ran them.

    Attributes:
        experiment: name of the MLflow experiment.
        systems: architectures.
        scenes: names of scenes.
        tags: (name, value) of tags or settings; values of one name are alternatives.
        since: when they started, at the earliest.
        until: when they started, before this.
        trials: runs of sweeps as well.
    """

    experiment: str | None = None
    systems: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()
    tags: tuple[tuple[str, str], ...] = ()
    since: Date | None = None
    until: Date | None = None
    trials: bool = False


def select_runs(runs: Sequence[Run], filters: Filters) -> tuple[list[Run], list[str]]:
    """The runs that pass all filters and have been tested, in their order.

    Returns:
        The runs, and notes on what was left out.

    Raises:
        ConfigError: nothing passes; the message names the filter and the values that exist.
    """
    notes = []
    kept = [run for run in runs if filters.trials or not run.trial]
    if not kept:
        raise ConfigError(f"all {len(runs)} finished runs are trials of sweeps; give --trials, or train with `fit`")
    kept = _keep_values(
        kept, "--experiment", [filters.experiment] if filters.experiment else [], lambda r: r.experiment
    )
    kept = _keep_values(kept, "--system", filters.systems, lambda run: run.system)
    kept = _keep_values(kept, "--scene", filters.scenes, lambda run: run.scene)
    for name in dict.fromkeys(name for name, _ in filters.tags):
        check_setting(name, kept)
        wanted = [value for other, value in filters.tags if other == name]
        kept = _keep_values(kept, f"--tag {name}=", wanted, lambda run, name=name: setting(run, name))
    kept = _keep_dates(kept, filters)
    tested = [run for run in kept if "test/position_median_m" in run.metrics]
    missing = len(kept) - len(tested)
    if not tested:
        trials = " (trials of a sweep never see test frames)" if any(run.trial for run in kept) else ""
        raise ConfigError(
            f"none of the {len(kept)} runs has test errors{trials}; "
            "measure a checkpoint with `python -m lightning_pose test --ckpt_path CKPT`"
        )
    if missing:
        notes.append(f"{missing} of {len(kept)} runs have no test errors, as most trials of sweeps: left out")
    return tested, notes


def setting(run: Run, name: str) -> str | None:
    """A tag or a parameter by its name; None where the run has none."""
    return run.settings.get(name)


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
    raise ConfigError(f"no run tells {name!r}, neither as a tag nor as a setting; {hint}")


def read_date(text: str, end: bool = False) -> Date:
    """An ISO date or time, of this machine's clock unless it names a zone.

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
        return Date(text, (date + timedelta(days=1) if end and whole_day else date).astimezone().timestamp() * 1e3)
    except (ValueError, OverflowError, OSError):  # which of them depends on the system
        raise ConfigError(f"{text!r} is out of range; give a date such as 2026-03-01") from None


def _keep_values(runs: list[Run], option: str, wanted: Sequence[str], value: Callable[[Run], str | None]) -> list[Run]:
    """The runs whose value is one of those wanted; all where nothing is."""
    if not wanted:
        return runs
    values = {run.run_id: value(run) for run in runs}
    there = sorted({told for told in values.values() if told is not None}, key=str)
    for want in wanted:
        if want not in there:
            more = f" and {len(there) - MOST} more" if len(there) > MOST else ""
            said = option + want if option.endswith("=") else f"{option} {want}"
            raise ConfigError(f"{said} matches no run; there is {', '.join(there[:MOST]) or 'none'}{more}")
    return [run for run in runs if values[run.run_id] in wanted]


def _keep_dates(runs: list[Run], filters: Filters) -> list[Run]:
    low = filters.since.milliseconds if filters.since else float("-inf")
    high = filters.until.milliseconds if filters.until else float("inf")
    kept = [run for run in runs if low <= run.started < high]
    if not kept:
        first, last = (
            datetime.fromtimestamp(end(run.started for run in runs) / 1e3).isoformat(" ", "minutes")
            for end in (min, max)
        )
        dates = {"--since": filters.since, "--until": filters.until}
        told = " ".join(f"{option} {date.text}" for option, date in dates.items() if date)
        raise ConfigError(f"{told} matches no run; the {len(runs)} others are from {first} to {last}")
    return kept
