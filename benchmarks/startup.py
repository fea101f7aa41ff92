"""Wall time of whole commands, from the start of Python on, beside the imports that they should do without.

    python -m benchmarks.startup [--rounds 5]

In a synthetic room, made by the benchmark. Each command is a process of its own, and rounds of all alternate. A command
that does not train should be done in 1.5 s; `fit` should be at its first batch 1.15 times after `import lightning`.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from lightning import Callback

from benchmarks.measurement import ROOT, Goal, Measurement, Options, format_table, interleave, time_process
from tests.stores import FakeRun, make_store

TORCH, LIGHTNING = "import torch", "import lightning"
LIMIT_S, LIMIT_RATIO = 1.5, 1.15
PROGRAM = ["-m", "lightning_pose"]
CACHED = 60
"""Frames of the smaller room, whose features are in the cache before `fit` is measured."""


class EndAtFirstBatch(Callback):
    """Ends the process before the first training step."""

    def on_train_batch_start(self, *args: object) -> None:
        os._exit(0)


def run(folder: Path, *words: object) -> None:
    """Run one command that the others need."""
    time_process([sys.executable, *map(str, words)], folder, {"LIGHTNING_POSE_CACHE": str(folder / "cache")})


def prepare(folder: Path) -> dict[str, list[str]]:
    """Render rooms, map one, export it, make a store; the command lines to measure, by what they are."""
    rooms = {frames: folder / f"room{frames}" for frames in (CACHED, 300)}
    for frames, room in rooms.items():
        run(folder, *PROGRAM, "synth", room, "--frames", frames)
    data = ["--data.root", str(rooms[CACHED]), "--report.log_model", "false"]
    run(folder, *PROGRAM, "fit", "--config", ROOT / "configs" / "landmark_map.yaml", *data)
    (checkpoint,) = (folder / "mlruns" / "checkpoints").glob("*/best.ckpt")
    run(folder, *PROGRAM, "export", checkpoint, "--out", folder / "exported")
    empty = folder / "empty.db"
    run(folder, "-c", f"from mlflow import MlflowClient; MlflowClient('sqlite:///{empty}').search_experiments()")
    uri = make_store(folder / "runs.db", empty, [FakeRun(scene=scene) for scene in ("chess", "fire", "heads")])
    image = str(next(rooms[CACHED].rglob("*.png")))
    train = ["fit", "--config", str(ROOT / "configs" / "surf_lstm.yaml"), *data]
    return {
        TORCH: ["-c", TORCH],
        LIGHTNING: ["-c", LIGHTNING],
        "`--help`": [*PROGRAM, "--help"],
        f"`check` of {CACHED} frames, 320x240": [*PROGRAM, "check", str(rooms[CACHED])],
        "`check` of 300 frames, 320x240": [*PROGRAM, "check", str(rooms[300])],
        "`report` of three runs": [*PROGRAM, "report", "--tracking_uri", uri],
        "`localize` of an image, exported map": [*PROGRAM, "localize", str(folder / "exported"), image],
        "`localizer.py` of that folder": [str(folder / "exported" / "localizer.py"), image],
        "`fit --help`": [*PROGRAM, "fit", "--help"],
        "`fit` to its first batch, features cached": [
            *PROGRAM, *train, "--trainer.callbacks+=benchmarks.startup.EndAtFirstBatch",
        ],
    }  # fmt: skip


def measure(options: Options) -> Iterator[Measurement]:
    """A row for each command."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        commands = prepare(folder)
        cache = {"LIGHTNING_POSE_CACHE": str(folder / "cache")}
        systems = {
            what: partial(time_process, [sys.executable, *words], folder, cache) for what, words in commands.items()
        }
        seconds = interleave(systems, options.rounds or 5)
    for what in commands:
        if what in (TORCH, LIGHTNING):
            continue
        peer = LIGHTNING if what.startswith("`fit") else TORCH
        goal = Goal("ratio", LIMIT_RATIO) if peer == LIGHTNING else Goal("ours", LIMIT_S)
        yield Measurement.from_rounds(what, seconds[what], f"`{peer}`", seconds[peer], goal)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    print(format_table([*measure(Options(rounds=parser.parse_args().rounds))]))


if __name__ == "__main__":
    main()
