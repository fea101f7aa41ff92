"""The rows of the table: what was done, how often, and what misbehaved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

__all__ = ["Row"]


@dataclass(frozen=True)
class Row:
    """One kind of abuse.

    Attributes:
        what: was done.
        times: how often.
        bad: what misbehaved, and how often.
        good: what came of the others.
    """

    what: str
    times: int
    bad: Mapping[str, int] = field(default_factory=dict)
    good: str = ""

    def __str__(self) -> str:
        bad = ", ".join(f"{number} x {kind}" for kind, number in self.bad.items()) or "0"
        return f"| {self.what} | {self.times} | {bad} | {self.good} |"
