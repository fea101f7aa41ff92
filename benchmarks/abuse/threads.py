"""The same `fit` twice with one thread, and with two: whether the weights and test metrics are the same numbers."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from benchmarks.abuse.kills import read_result
from benchmarks.abuse.table import Row
from benchmarks.abuse.workplace import SYSTEMS, Workplace

__all__ = ["compare_threads"]


def compare_threads(base: Workplace, times: int | None) -> Iterator[Row]:
    """Train each system with one thread, again with one, and with two; a row each.

    Args:
        base: a workplace.
        times: not used.
    """
    for system in filter(base.wants, SYSTEMS):
        config = base.config(system)
        results = []
        for threads in ("1", "1", "2"):
            place = base.copy()
            environment = {**os.environ, **place.environment, "OMP_NUM_THREADS": threads, "PYTHONPATH": str(Path.cwd())}
            command = [sys.executable, "-m", "lightning_pose", "fit", "--config", str(config)]
            subprocess.run(command, cwd=place.folder, env=environment, check=True, capture_output=True)
            results.append(read_result(place))
        first, again, two = results
        bad = {"one thread, twice": 1} if first != again else {}
        yield Row(
            f"`fit` of {system} again, with one and two threads",
            2,
            bad,
            "the same numbers" if two == first else "other numbers with two threads",
        )
