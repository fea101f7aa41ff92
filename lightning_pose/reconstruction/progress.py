"""Shows on the terminal how far each step of a reconstruction is, and keeps how long each took."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

__all__ = ["StepProgress"]

Item = TypeVar("Item")


class StepProgress:
    """A bar for the step that runs.

    Args:
        console: of the bar; standard error by default. Where it is no terminal, nothing is shown.

    Attributes:
        seconds: how long each finished step took, by its name.
    """

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True, emoji=False)
        self.seconds: dict[str, float] = {}

    def track(self, items: Iterable[Item], step: str, total: int | None) -> Iterator[Item]:
        """Yield the items of a step, and show how many of the total are done; no bar for a total of 0."""
        if total == 0:
            yield from items
            return
        with self._show(step, total) as (bar, task):
            for item in items:
                yield item
                bar.advance(task)

    @contextmanager
    def wait(self, step: str) -> Iterator[None]:
        """Show the time that a step takes whose length is not known."""
        with self._show(step, None):
            yield

    @contextmanager
    def _show(self, step: str, total: int | None) -> Iterator[tuple[Progress, TaskID]]:
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
        start = time.monotonic()
        disabled = not self._console.is_terminal
        with Progress(*columns, console=self._console, transient=True, disable=disabled) as bar:
            yield bar, bar.add_task(step, total=total)
        self.seconds[step] = self.seconds.get(step, 0.0) + time.monotonic() - start
