"""The checker of shapes in signatures, `Float[Tensor, "*batch 4"]`, which `conftest.py` turns on for all tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype
from jaxtyping import install_import_hook

__all__ = ["check_shapes", "turn_on_checks"]

CHECKED = ["lightning_pose.geometry", "lightning_pose.losses"]

# With the numeric tower of PEP 484, an int is accepted where a signature says float.
check_all = beartype(conf=BeartypeConf(is_pep484_tower=True))


def turn_on_checks() -> None:
    """Check the signatures of modules in `CHECKED`; call it before anything imports them."""
    install_import_hook(CHECKED, "tests.shapes.check_shapes")


def check_shapes(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check a function's arguments and results if its signature has a shape.

    Other signatures are left alone: tests pass wrong values on purpose, to see the error that a user would get.
    """
    annotations = map(str, function.__annotations__.values())
    return check_all(function) if any("Float" in annotation for annotation in annotations) else function
