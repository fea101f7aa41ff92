"""`kill -9` at single operations on files: while `fit` writes a map, and while `export` replaces a folder."""

from __future__ import annotations

import shutil
import signal
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.abuse.faults import preload_faults, run_faulty
from benchmarks.abuse.kills import GOOD, read_result, resume_fit
from benchmarks.abuse.table import Row
from benchmarks.abuse.workplace import Workplace
from lightning_pose.checkpoint import read_checkpoint
from lightning_pose.errors import PoseError
from tests.processes import ForkedProcess

__all__ = ["kill_writes"]


def kill_writes(base: Workplace, times: int | None) -> Iterator[Row]:
    """Kill `fit` while it writes the checkpoints of a map, and `export --overwrite` at any write; a row each.

    Args:
        base: a workplace.
        times: at how many operations at most, spread over all; 30 by default.
    """
    library, count = preload_faults(base.folder.parent), 30 if times is None else times
    words = ("fit", "--config", base.config("LandmarkMap"))
    assert base.run(*words).code == 0
    if base.wants("fit"):
        yield _kill_map(base, library, words, count)
    if base.wants("export"):
        yield _kill_export(base, library, base.checkpoint(base.runs()[0], "best"), count)


def _kill_map(base: Workplace, library: Path, words: Sequence[object], count: int) -> Row:
    place = base.copy()
    total = _run_killed(place, library, "mlruns/checkpoints", words, 0)
    expected, found = read_result(place), Counter[str]()
    steps = _spread(total, count)
    for step in steps:
        place = base.copy()
        ended = _run_killed(place, library, "mlruns/checkpoints", words, step) > 0
        if not all(map(_is_whole, (place.folder / "mlruns" / "checkpoints").rglob("*.ckpt"))):
            found["half a checkpoint"] += 1
        else:
            found[resume_fit(place, words, ended, expected)] += 1
    bad = {kind: times for kind, times in found.items() if kind not in GOOD}
    good = ", ".join(f"{found[kind]} {kind}" for kind in GOOD if found[kind])
    return Row(f"kill -9 at {len(steps)} of {total} writes of a map's checkpoints in `fit`", len(steps), bad, good)


def _is_whole(file: Path) -> bool:
    try:
        read_checkpoint(file)
    except PoseError:
        return False
    return True


def _kill_export(base: Workplace, library: Path, best: Path, count: int) -> Row:
    words = ("export", best, "--out", "exported", "--overwrite")
    old = base.folder / "exported"
    assert base.run("export", best, "--out", old).code == 0
    image = base.room / "seq-01" / "frame-000000.color.png"
    answer = ("localize", "exported", image)
    place = _copy_exported(base, old)
    total = _run_killed(place, library, "", words, 0)
    steps, found = _spread(total, count), Counter[str]()
    for step in steps:
        place = _copy_exported(base, old)
        _run_killed(place, library, "", words, step)
        if place.complete(*answer).code not in (0, 1):
            found["half a folder"] += 1
        elif place.complete(*words).code != 0 or place.complete(*answer).code not in (0, 1):
            found["fails afterwards"] += 1
        else:
            found["whole"] += 1
    bad = {kind: times for kind, times in found.items() if kind != "whole"}
    name = f"kill -9 at {len(steps)} of {total} writes of `export --overwrite`"
    return Row(name, len(steps), bad, f"{found['whole']} whole, old or new")


def _copy_exported(base: Workplace, old: Path) -> Workplace:
    place = base.copy()
    shutil.copytree(old, place.folder / "exported")
    return place


def _run_killed(place: Workplace, library: Path, below: str, words: Sequence[object], step: int) -> int:
    """Kill a command at an operation on files below a folder, 0 for none; how many it did, 0 if it was killed."""
    counted = place.folder.parent / "count"
    counted.write_text("0")
    folder = place.folder / below
    args = ([str(word) for word in words], str(library), str(folder), step, step, -signal.SIGKILL, counted)
    with ForkedProcess(run_faulty, *args, folder=place.folder, environment=place.environment) as process:
        process.communicate(500)
        code = process.wait()
    assert code in (0, -signal.SIGKILL), f"exit code {code} of {words[0]} at operation {step}"
    return int(counted.read_text())


def _spread(total: int, count: int) -> list[int]:
    """So many numbers from 1 to `total`, evenly spread."""
    return sorted({1 + i * (total - 1) // max(1, count - 1) for i in range(count)})
