"""Disks that are full or broken at each operation of a command, a read-only home, and a store that is locked.

The faults come from `faults.c`, which stands between the command and the C library; it needs Linux and gcc.
"""

from __future__ import annotations

import ctypes
import errno
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.abuse.signals import list_torn
from benchmarks.abuse.stores import try_stores
from benchmarks.abuse.table import Row
from benchmarks.abuse.workplace import Ended, Workplace, run_command
from tests.processes import ForkedProcess

__all__ = ["break_disks", "preload_faults", "run_faulty"]

SOURCE = Path(__file__).parent / "faults.c"

ALL = 1 << 60


def break_disks(base: Workplace, times: int | None) -> Iterator[Row]:
    """Let operations on files fail; a row for each command and fault.

    Args:
        base: a workplace.
        times: at how many operations of each command, spread over all of them; 30 by default.
    """
    library = preload_faults(base.folder.parent)
    count = 30 if times is None else times
    config = base.config("refined")
    assert base.run("fit", "--config", config).code == 0
    best = base.checkpoint(base.runs()[0], "best")
    commands: dict[str, Sequence[object]] = {
        "extract": ("extract", "--config", config),
        "fit": ("fit", "--config", config),
        "export": ("export", best, "--out", "exported"),
    }
    for name, words in ((name, words) for name, words in commands.items() if base.wants(name)):
        disk = Disk(base, library, words, empty=name == "extract")
        for text, number, lasts in (("disk full", errno.ENOSPC, True), ("one EIO", errno.EIO, False)):
            yield disk.try_all(f"{text} in `{name}`", number, lasts, count)
    if base.wants("home"):
        yield _try_home(base, library, config)
    yield from try_stores(base)


def preload_faults(folder: Path) -> Path:
    """Compile `faults.c` into a folder, and let the server that processes are forked off begin with it; its file.

    It is called before the first process is forked, as the server begins then.
    """
    if "LD_PRELOAD" in os.environ:
        return Path(os.environ["LD_PRELOAD"])
    library = folder / "faults.so"
    subprocess.run(["gcc", "-shared", "-fPIC", "-O1", "-o", library, SOURCE, "-ldl"], check=True)
    os.environ["LD_PRELOAD"] = str(library)
    return library


class Disk:
    """A command whose operations on files below its folder fail.

    Args:
        base: the workplace whose copies it runs in.
        library: the compiled `faults.c`.
        words: the command.
        empty: whether there are no features yet.
    """

    def __init__(self, base: Workplace, library: Path, words: Sequence[object], empty: bool) -> None:
        self.base, self.library, self.words, self.empty = base, library, words, empty

    def try_all(self, what: str, number: int, lasts: bool, count: int) -> Row:
        """Run it with a fault at operations spread over all of them."""
        place = self._copy()
        _, total = self._run(place, 0, 0, number)
        steps = sorted({1 + i * (total - 1) // max(1, count - 1) for i in range(count)})
        found: Counter[str] = Counter()
        for step in steps:
            found[self._try(step, ALL if lasts else step, number)] += 1
        good = {"one line", "done all the same"}
        bad = {kind: times for kind, times in found.items() if kind not in good}
        ends = ", ".join(f"{found[kind]} {kind}" for kind in sorted(good))
        return Row(f"{what}, at {len(steps)} of {total} operations", len(steps), bad, ends)

    def _try(self, first: int, last: int, number: int) -> str:
        """What came of faults at these operations, and of the same command afterwards."""
        place = self._copy()
        ended, _ = self._run(place, first, last, number)
        if not ended.is_clean:
            where = f"{place.folder.parent}/failed-{self.words[0]}-{number}-{first}.txt"
            Path(where).write_text(ended.stderr)
            return f"exit code {ended.code}" + (" with a traceback" if "Traceback" in ended.stderr else "")
        if list_torn(place.folder):
            return "torn file"
        again = [*self.words, *(["--overwrite"] if self.words[0] == "export" and ended.code == 0 else [])]
        if place.complete(*again).code != 0:
            return "fails afterwards"
        if any(run.info.status == "RUNNING" for run in place.runs()):
            return "run left RUNNING"
        return "one line" if ended.code else "done all the same"

    def _copy(self) -> Workplace:
        return self.base.copy(features=not self.empty)

    def _run(self, place: Workplace, first: int, last: int, number: int) -> tuple[Ended, int]:
        """The end of the command, and the number of its operations."""
        counted = place.folder.parent / "count"
        args = ([str(word) for word in self.words], str(self.library), str(place.folder), first, last, number, counted)
        with ForkedProcess(run_faulty, *args, folder=place.folder, environment=place.environment) as process:
            _, errors = process.communicate(500)
            return Ended(process.wait(), errors), int(counted.read_text())


def run_faulty(words: list[str], library: str, folder: str, first: int, last: int, number: int, counted: Path) -> int:
    """A command whose operations `first` to `last` on files below a folder fail; their number goes to a file."""
    faults = ctypes.CDLL(library)
    faults.fault_arm.argtypes = [ctypes.c_char_p, ctypes.c_long, ctypes.c_long, ctypes.c_int]
    faults.fault_count.restype = ctypes.c_long
    faults.fault_arm(f"{folder}/".encode(), first, last, number)
    try:
        return run_command(words)
    finally:
        count = faults.fault_count()
        faults.fault_arm(b"", 0, 0, 0)  # what Python does at its end is not the command's
        counted.write_text(str(count))
        sys.stderr.flush()


def _try_home(base: Workplace, library: Path, config: Path) -> Row:
    """Extract where neither the home nor a cache can be written."""
    place = base.copy(features=False)
    home = place.folder / "home"
    home.mkdir()
    environment = {
        "HOME": str(home),
        "XDG_CACHE_HOME": "",
        "LIGHTNING_POSE_CACHE": "",
        "MLFLOW_TRACKING_URI": place.uri,
    }
    found: Counter[str] = Counter()
    for verb in ("extract", "fit"):
        args = ([verb, "--config", str(config)], str(library), str(home), 1, ALL, errno.EROFS, home.parent / "count")
        with ForkedProcess(run_faulty, *args, folder=place.folder, environment=environment) as process:
            _, errors = process.communicate(200)
            ended = Ended(process.wait(), errors)
        found["one line" if ended.is_clean and ended.code else f"exit code {ended.code}"] += 1
    bad = {kind: times for kind, times in found.items() if kind != "one line"}
    return Row("read-only home in `extract` and `fit`", 2, bad, f"{found['one line']} one line")
