"""`report` over a store of 1,000 runs against `mlflow.search_runs` and a pandas pivot of the same store.

    python -m benchmarks.report [--runs 1000] [--epochs 20] [--rounds 5]

Both are processes of their own, from start to end, as a user waits for them; rounds alternate. The runs have 60
settings, 60 metrics with a history over epochs, and tags. The goal is under 3 seconds.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.measurement import Goal, Measurement, Options
from tests.stores import make_store, many_runs

ROOT = Path(__file__).parents[1]
LIMIT_S = 3

PEER = """
import sys
import mlflow
mlflow.set_tracking_uri(sys.argv[1])
finished = "attributes.status = 'FINISHED'"
runs = mlflow.search_runs(search_all_experiments=True, filter_string=finished, max_results=50000)
best = runs.sort_values("metrics.val/position_median_m").drop_duplicates(["tags.architecture", "tags.scene"])
errors = ["metrics.test/position_median_m", "metrics.test/orientation_median_deg"]
table = best.pivot(index="tags.architecture", columns="tags.scene", values=errors)
print(table.to_string())
"""


def seconds(command: list[str]) -> float:
    """Of one process, whose answer is thrown away."""
    start = time.perf_counter()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, *command], check=True, stdout=subprocess.DEVNULL, env=environment)
    return time.perf_counter() - start


def time_both(runs: int, epochs: int, rounds: int) -> list[tuple[float, float]]:
    """Seconds of `report` and of the peer, round by round."""
    from mlflow import MlflowClient  # seconds, and the processes under test import their own

    with tempfile.TemporaryDirectory() as folder:
        empty = Path(folder) / "empty.db"
        MlflowClient(f"sqlite:///{empty}").search_experiments()
        uri = make_store(Path(folder) / "mlflow.db", empty, many_runs(runs), epochs)
        ours = ["-m", "lightning_pose", "report", "--tracking_uri", uri]
        theirs = ["-c", PEER, uri]
        return [(seconds(ours), seconds(theirs)) for _ in range(rounds + 1)][1:]  # the first round warms up


def measure(options: Options) -> Iterator[Measurement]:
    """One row, of 1,000 runs."""
    pairs = time_both(1000, 20, options.rounds or 5)
    one, other = (statistics.median(column) for column in zip(*pairs, strict=True))
    ratio, what = statistics.median(a / b for a, b in pairs), "`report` of 1,000 runs"
    yield Measurement(what, one, "`mlflow.search_runs` and a pandas pivot", other, ratio, Goal("ours", LIMIT_S))


def main() -> None:
    """Print the median times and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--epochs", type=int, default=20, help="values in the history of each metric")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    pairs = time_both(args.runs, args.epochs, args.rounds)
    one, other = (statistics.median(column) for column in zip(*pairs, strict=True))
    print(f"{args.runs} runs, {args.epochs} epochs, median of {args.rounds} rounds, start of Python included")
    print(f"report {one:.2f} s, mlflow.search_runs and a pivot {other:.2f} s")
    print(f"ratio {statistics.median(a / b for a, b in pairs):.3f}")


if __name__ == "__main__":
    main()
