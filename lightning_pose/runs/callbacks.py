"""find_callback: a trainer's callback of one class."""

from __future__ import annotations

from typing import TypeVar

from lightning import Callback, Trainer

__all__ = ["find_callback"]

Kind = TypeVar("Kind", bound=Callback)


def find_callback(trainer: Trainer, kind: type[Kind]) -> Kind | None:
    """The trainer's first callback of a class; None if it has none."""
    callbacks: list[Callback] = getattr(trainer, "callbacks", [])  # Lightning does not declare the attribute
    return next((callback for callback in callbacks if isinstance(callback, kind)), None)
