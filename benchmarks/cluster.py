"""Extraction, a sweep and `localize` on a Dask cluster of two workers on loopback, against one process.

    python -m benchmarks.cluster [--frames 600] [--trials 4]

Everything runs on this machine, as users type it: `dask scheduler`, two `dask worker` with one thread each, and the
commands, in the synthetic room. Wall seconds of whole commands, imports included. "killed" is the same with one of the
workers killed (`kill -9`) halfway, which nothing replaces. Each row checks that nothing is lost: all records in the
cache, all trials complete, one line for each image.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import yaml

CONFIGS = Path(__file__).parents[1] / "configs"


class Place:
    """A folder with a scene and a store, in which commands and workers run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        packages = os.pathsep.join([str(CONFIGS.parent), os.environ.get("PYTHONPATH", "")])
        self.environment = {**os.environ, "PYTHONPATH": packages, "LIGHTNING_POSE_CACHE": str(folder / "cache")}
        self.environment["OMP_NUM_THREADS"] = "1"

    def start(self, *words: object) -> subprocess.Popen[bytes]:
        log = (self.folder / "log.txt").open("ab")
        command = [sys.executable, "-m", *map(str, words)]
        return subprocess.Popen(command, cwd=self.folder, env=self.environment, stdout=log, stderr=log)

    def run(self, *words: object) -> float:
        """Wall seconds of a command."""
        start = time.perf_counter()
        if self.start("lightning_pose", *words).wait() != 0:
            raise SystemExit(f"{words} failed:\n{(self.folder / 'log.txt').read_text()[-2000:]}")
        return time.perf_counter() - start

    @contextmanager
    def serve(self) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
        """A cluster of two workers: its address, and their processes."""
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        address = f"tcp://127.0.0.1:{port}"
        words = ["--nthreads", 1, "--no-nanny", "--no-dashboard"]
        with ExitStack() as stack:
            scheduler = self.start("dask", "scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")
            workers = [self.start("dask", "worker", address, *words) for _ in range(2)]
            for process in (*workers, scheduler):
                stack.callback(_end, process)
            from distributed import Client

            with Client(address, set_as_default=False, timeout=60) as client:
                client.wait_for_workers(2, timeout=60)
            yield address, workers


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


def _kill_after(seconds: float, process: subprocess.Popen[bytes]) -> threading.Timer:
    timer = threading.Timer(seconds, os.kill, (process.pid, signal.SIGKILL))
    timer.start()
    return timer


def measure(
    place: Place, make_words: Callable[[str], list[object]], check: Callable[[], str], own: list[object]
) -> str:
    """A row of the table: one process, two workers, two of which one is killed, and what was checked."""
    alone = place.run(*make_words("alone"), *own)
    checked = check()
    with place.serve() as (address, _):
        together = place.run(*make_words("together"), "--scheduler", address)
        checked += f"; {check()}"
    with place.serve() as (address, workers):
        timer = _kill_after(together / 2, workers[0])
        killed = place.run(*make_words("killed"), "--scheduler", address)
        timer.cancel()
        state = "" if workers[0].poll() is not None else " (too late to kill)"
        checked += f"; {check()}{state}"
    return f"| {alone:.1f} | {together:.1f} | {alone / together:.2f} | {killed:.1f} | {checked} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--trials", type=int, default=4)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        place = Place(Path(scratch))
        place.run("synth", "room", "--frames", args.frames)
        images = sorted((place.folder / "room").rglob("*.png"))
        print("| what | one process, s | two workers, s | ratio | one killed, s | checked each time |")
        print("|---|---:|---:|---:|---:|---|")

        def extract(name: str) -> list[object]:
            place.environment["LIGHTNING_POSE_CACHE"] = str(place.folder / f"cache_{name}")
            return ["extract", "--config", CONFIGS / "landmark_map.yaml", "--data.root", "room"]

        def count_records() -> str:
            cache = Path(place.environment["LIGHTNING_POSE_CACHE"])
            return f"{len([file for file in cache.rglob('*') if file.suffix == '.safetensors'])} records"

        row = measure(place, extract, count_records, ["--data.workers", 1])
        print(f"| `extract`, {len(images)} images {row}", flush=True)
        settings = {"trainer.max_epochs": 15}
        space = {"model.units": [100 + 10 * i for i in range(args.trials)]}
        sweep = {"base": str(CONFIGS / "surf_lstm.yaml"), "sampler": "grid", "space": space, "settings": settings}
        (place.folder / "units.yaml").write_text(yaml.safe_dump(sweep))
        place.run("extract", "--config", CONFIGS / "surf_lstm.yaml", "--data.root", "room")

        def search(name: str) -> list[object]:
            return ["sweep", "units.yaml", "--data.root", "room", "--study", name]

        def count_trials() -> str:
            with sqlite3.connect(place.folder / "mlruns" / "optuna.db") as store:
                (total,) = store.execute("select count(*) from trials where state = 'COMPLETE'").fetchone()
            return f"{total} trials complete"

        row = measure(place, search, count_trials, ["--workers", 1])
        print(f"| `sweep`, {args.trials} trials {row}", flush=True)
        place.run("fit", "--config", CONFIGS / "landmark_map.yaml", "--data.root", "room")
        (model,) = (place.folder / "mlruns" / "checkpoints").glob("*/best.ckpt")

        def locate(name: str) -> list[object]:
            return ["localize", model, *sorted((place.folder / "room").glob("seq-*")), "--out", f"{name}.csv"]

        def count_lines() -> str:
            newest = max(place.folder.glob("*.csv"), key=lambda file: file.stat().st_mtime)
            names = [line.split(",")[0] for line in newest.read_text().splitlines()[1:]]
            return f"{len(names)} lines, {len(set(names))} images"

        row = measure(place, locate, count_lines, ["--workers", 1])
        print(f"| `localize`, {len(images)} images {row}", flush=True)


if __name__ == "__main__":
    main()
