"""Processes of tests, forked off a server that has the imports: a fresh Python takes seconds for them each time."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Mapping
from multiprocessing import forkserver
from pathlib import Path
from unittest import mock

__all__ = ["ForkedProcess", "start_fork_server"]

PRELOADED = [
    "tests.helpers",
    "lightning_pose.cli",
    "lightning_pose.commands.sweep",
    "lightning_pose.sweeps.workers",
    "distributed",
]


def start_fork_server() -> None:
    """Start the server of this test process, unless it runs; workers of sweeps are forked off it too.

    It keeps the environment that it begins with: no test's store, and Ctrl-C counts, which whoever runs the tests in
    the background has them ignore.
    """
    multiprocessing.get_context("forkserver").set_forkserver_preload(PRELOADED)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with mock.patch.dict(os.environ):
            os.environ.pop("MLFLOW_TRACKING_URI", None)
            forkserver.ensure_running()
    finally:
        signal.signal(signal.SIGINT, before)


class ForkedProcess:
    """A function in a process of its own, handled as `subprocess.Popen`: the exit code is what the function returns.

    Args:
        function: of a module that can be imported.
        args: its arguments; they can be pickled.
        folder: current folder of the process.
        environment: variables on top of those of the tests.
    """

    def __init__(
        self, function: Callable[..., int | None], *args: object, folder: Path, environment: Mapping[str, str]
    ) -> None:
        start_fork_server()
        self._output = tempfile.TemporaryDirectory()
        self._files = [Path(self._output.name) / name for name in ("stdout", "stderr")]
        words = function, args, folder, {**os.environ, **environment}, self._files
        self._process = multiprocessing.get_context("forkserver").Process(target=_run, args=words)
        self._process.start()

    @property
    def pid(self) -> int:
        return self._process.pid or 0

    @property
    def returncode(self) -> int | None:
        """The exit code, minus the signal's number where one ended it; None while it runs."""
        return self._process.exitcode

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float = 200) -> int:
        self._process.join(timeout)
        assert self.returncode is not None, f"it still runs after {timeout} s"
        return self.returncode

    def communicate(self, timeout: float = 200) -> tuple[str, str]:
        """Wait for its end; what it printed, and what it printed to standard error."""
        self.wait(timeout)
        stdout, stderr = (file.read_text() for file in self._files)
        return stdout, stderr

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def kill(self) -> None:
        self._process.kill()

    def __enter__(self) -> ForkedProcess:
        return self

    def __exit__(self, *error: object) -> None:
        self.kill()
        self._process.join()


def _run(
    function: Callable[..., int | None],
    args: tuple[object, ...],
    folder: Path,
    environment: Mapping[str, str],
    files: list[Path],
) -> None:
    for number, file in enumerate(files, start=1):
        with file.open("wb") as opened:
            os.dup2(opened.fileno(), number)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(function(*args))
