"""What the benchmarks of speed find: rows of one table, each with ours beside a named peer and a goal."""

from __future__ import annotations

import math
import os
import platform
import resource
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from typing import Any, Literal, NamedTuple

__all__ = [
    "Goal", "Measurement", "Options", "Seconds", "describe_machine", "format_table", "interleave",
    "restore_measurement", "time_process", "time_work",
]  # fmt: skip

ROOT = Path(__file__).parents[1]

PACKAGES = ("torch", "lightning", "mlflow", "scikit-learn", "numpy", "opencv-contrib-python-headless")
"""Those whose versions the table names."""


class Goal(NamedTuple):
    """A bound on a measurement: of the ratio to the peer, or of our own number."""

    of: Literal["ratio", "ours"]
    bound: float
    at_least: bool = False


class Seconds(NamedTuple):
    """Wall time, and the CPU time of all threads and of processes that were started."""

    wall: float
    cpu: float


@dataclass(frozen=True)
class Options:
    """What a benchmark may need.

    Attributes:
        root: folder of a real scene; None where the user gives none.
        pgt: folder of the pseudo ground truth of that scene, or None.
        rounds: how often everything is measured; None for the benchmark's own number.
    """

    root: str | None = None
    pgt: str | None = None
    rounds: int | None = None


@dataclass(frozen=True)
class Measurement:
    """One row.

    Attributes:
        what: is measured.
        ours: median over the rounds.
        peer: what it is measured against; empty for none.
        theirs: the peer's median.
        ratio: median over the rounds of ours by the peer's, or of the peer's by ours where the goal is a lower bound.
        goal: that it should reach.
        ours_cpu: CPU seconds, where the others are wall time.
        theirs_cpu: of the peer.
        unit: of ours and theirs.
    """

    what: str
    ours: float
    peer: str
    theirs: float
    ratio: float
    goal: Goal
    ours_cpu: float = math.nan
    theirs_cpu: float = math.nan
    unit: str = "s"

    @property
    def met(self) -> bool:
        value = self.ratio if self.goal.of == "ratio" else self.ours
        return value >= self.goal.bound if self.goal.at_least else value <= self.goal.bound

    @property
    def row(self) -> list[str]:
        """The cells of the table."""
        bound = f"{self.goal.bound:g}" + ("" if self.goal.of == "ratio" else f" {self.unit}")
        return [
            self.what,
            _format_number(self.ours, self.ours_cpu, self.unit),
            self.peer,
            _format_number(self.theirs, self.theirs_cpu, self.unit),
            "" if math.isnan(self.ratio) else f"{self.ratio:.2f}",
            f"{'ratio ' if self.goal.of == 'ratio' else ''}{'at least' if self.goal.at_least else 'at most'} {bound}",
            "yes" if self.met else "no",
        ]

    @staticmethod
    def from_rounds(
        what: str, ours: Sequence[Seconds], peer: str, theirs: Sequence[Seconds], goal: Goal
    ) -> Measurement:
        """Medians of rounds; the ratio is that of wall times, round by round."""
        pairs = zip(ours, theirs, strict=True)
        ratios = [(b.wall / a.wall if goal.at_least else a.wall / b.wall) for a, b in pairs]
        (wall, cpu), (peer_wall, peer_cpu) = (
            (median(each.wall for each in rounds), median(each.cpu for each in rounds)) for rounds in (ours, theirs)
        )
        return Measurement(what, wall, peer, peer_wall, median(ratios), goal, cpu, peer_cpu)


def restore_measurement(values: Mapping[str, Any]) -> Measurement:
    """A measurement from its fields, as JSON has them."""
    return Measurement(**{**values, "goal": Goal(*values["goal"])})


def _format_number(value: float, cpu: float, unit: str) -> str:
    if math.isnan(value):
        return ""
    return f"{value:.3g} {unit}" + ("" if math.isnan(cpu) else f" ({cpu:.3g} {unit} CPU)")


def format_table(found: Sequence[Measurement]) -> str:
    """The measurements as a Markdown table."""
    head = ["what", "ours", "peer", "peer's", "ratio", "goal", "met"]
    rows = [head, ["---"] * len(head), *(each.row for each in found)]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def describe_machine() -> str:
    """The processor, its cores and how busy they are, versions, and the date, in one paragraph."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    name = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    load = ", ".join(f"{each:.1f}" for each in os.getloadavg())
    versions = ", ".join(f"{package} {_find_version(package)}" for package in PACKAGES)
    return (
        f"{name}, {os.cpu_count()} cores, load {load} (1, 5 and 15 minutes, our own included); "
        f"Python {platform.python_version()}, {versions}; {date.today():%Y-%m-%d}."
    )


def _find_version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "missing"


def time_process(command: Sequence[str], folder: Path, environment: Mapping[str, str] | None = None) -> Seconds:
    """Time a process from its start to its end; what it prints is thrown away.

    Raises:
        CalledProcessError: it fails.
    """
    paths = f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    variables = {**os.environ, "PYTHONPATH": paths, **(environment or {})}
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, cwd=folder, env=variables, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return Seconds(wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)


def time_work(work: Callable[[], object]) -> Seconds:
    """Time a function in this process, and in processes that it starts and ends."""
    wall, cpu = time.perf_counter(), sum(os.times()[:4])
    work()
    return Seconds(time.perf_counter() - wall, sum(os.times()[:4]) - cpu)


def interleave(systems: Mapping[str, Callable[[], Seconds]], rounds: int) -> dict[str, list[Seconds]]:
    """Measure all systems once in each round; a first round, which is not counted, warms up."""
    seconds: dict[str, list[Seconds]] = {name: [] for name in systems}
    for i in range(rounds + 1):
        for name, measure in systems.items():
            found = measure()
            if i:
                seconds[name].append(found)
    return seconds
