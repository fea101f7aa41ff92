"""Pace: how often training stops to write, so that short epochs do not wait for the disk."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["Pace"]

SHARE = 100
"""So many times as long as the last write took is the time until the next one."""

LONGEST_S = 20.0
"""The longest time until the next one: what a process that is killed can lose."""


class Pace:
    """Says when the next write is due: the first at once, and others after many times as long as the last one took."""

    def __init__(self) -> None:
        self._next = 0.0

    @property
    def is_due(self) -> bool:
        return time.monotonic() >= self._next

    @contextmanager
    def measure(self) -> Iterator[None]:
        """Time a write."""
        began = time.monotonic()
        try:
            yield
        finally:
            now = time.monotonic()
            self._next = now + min(SHARE * (now - began), LONGEST_S)
