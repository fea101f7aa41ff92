"""SIGINT, SIGTERM, SIGHUP and a closed terminal, sent to each long command at moments spread over its time."""

from __future__ import annotations

import os
import pty
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from benchmarks.abuse.table import Row
from benchmarks.abuse.workplace import Workplace
from benchmarks.measurement import ROOT

__all__ = ["send_signals"]

SIGNALS = {"SIGINT": signal.SIGINT, "SIGTERM": signal.SIGTERM, "SIGHUP": signal.SIGHUP}

MOST_SECONDS = 60
"""How long a command may take to end."""


def send_signals(base: Workplace, times: int | None) -> Iterator[Row]:
    """Send each signal to each command; a row each.

    Args:
        base: a workplace.
        times: how often, 6 by default.
    """
    count = 6 if times is None else times
    config = base.config("SurfLSTM")
    assert base.run("fit", "--config", config).code == 0
    best = base.checkpoint(base.runs()[0], "best")
    images = sorted(base.room.glob("seq-*/*.png"))
    sweep = base.folder / "sweep.yaml"
    sweep.write_text(f"base: {config}\nn_trials: 30\nspace: {{model.units: [8, 12, 16]}}\n")
    commands: dict[str, tuple[Sequence[object], float]] = {
        "fit": (("fit", "--config", base.config("SurfLSTM", epochs=1000)), 6.0),
        "extract": (("extract", "--config", config), 1.5),
        "sweep": (("sweep", sweep, "--workers", 1), 6.0),
        "sweep of two workers": (("sweep", sweep, "--workers", 2), 8.0),
        "localize": (("localize", best, *images * 50, "--out", "poses.tum"), 6.0),
        "serve": (("serve", best, "--port", 0), 6.0),
    }
    for name, (words, seconds) in commands.items():
        for text, number in SIGNALS.items():
            found = Counter(
                _send(base, words, number, seconds * (i + 1) / count, name == "extract") for i in range(count)
            )
            yield _make_row(f"{text} to `{name}`", count, found)
    found = Counter(_hang_up(base, commands["fit"][0], 3.0 + 6.0 * (i + 1) / count) for i in range(count))
    yield _make_row("terminal of `fit` closed", count, found)


def _make_row(what: str, count: int, found: Counter[str]) -> Row:
    bad = {kind: number for kind, number in found.items() if kind not in ("stopped", "had ended")}
    return Row(what, count, bad, f"{found['stopped']} stopped with the right code, {found['had ended']} had ended")


def _send(base: Workplace, words: Sequence[object], number: int, seconds: float, empty: bool) -> str:
    """Start a command, send it a signal after some time, and say what came of it."""
    place = base.copy(features=not empty)
    with place.fork(*words) as process:
        time.sleep(seconds)
        process.send_signal(number)
        code = _wait(process.poll)
        if code is None:
            return "does not end"
        _, errors = process.communicate()
    if code == 0:
        return "had ended"
    if code != 128 + number:
        return f"exit code {code}"
    return judge_left_over(place, errors)


def judge_left_over(place: Workplace, errors: str) -> str:
    """What is wrong with what a command has left that was stopped; `stopped` if nothing is."""
    if "Traceback" in errors:
        return "traceback"
    if any(run.info.status == "RUNNING" for run in place.runs()):
        return "run left RUNNING"
    if list_torn(place.folder):
        return "torn file"
    return "stopped"


def list_torn(folder: Path) -> list[Path]:
    """Temporary files that are left in a folder."""
    return [file for file in folder.rglob("*") if file.suffix in (".tmp", ".new", ".copy", ".unfinished", ".exporting")]


def _wait(poll: Callable[[], int | None]) -> int | None:
    """The exit code; None if it does not come."""
    deadline = time.monotonic() + MOST_SECONDS
    while (code := poll()) is None and time.monotonic() < deadline:
        time.sleep(0.02)
    return code


def _hang_up(base: Workplace, words: Sequence[object], seconds: float) -> str:
    """Run a command on a terminal of its own, and close that."""
    place = base.copy()
    process, terminal = pty.fork()
    if process == 0:  # the child, which has none of this process's threads, and must not wait for them
        os.chdir(place.folder)
        command = [sys.executable, "-m", "lightning_pose", *map(str, words)]
        os.execvpe(command[0], command, {**os.environ, **place.environment, "PYTHONPATH": str(ROOT)})  # noqa: S606
    deadline = time.monotonic() + seconds
    os.set_blocking(terminal, False)
    while time.monotonic() < deadline:
        try:
            os.read(terminal, 65536)
        except BlockingIOError:
            time.sleep(0.02)
    os.close(terminal)

    def poll() -> int | None:
        ended, status = os.waitpid(process, os.WNOHANG)
        return os.waitstatus_to_exitcode(status) if ended else None

    code = _wait(poll)
    if code is None:
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
        return "does not end"
    if code != 128 + signal.SIGHUP:
        return f"exit code {code}"
    return judge_left_over(place, "")
