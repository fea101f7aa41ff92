"""Plain descriptions of objects: a class path and plain constructor arguments, as config files write them."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from lightning_pose.errors import CheckpointError

__all__ = ["Spec", "build", "class_path", "describe"]

Spec = dict[str, Any]
"""`{"class_path": "package.module.Class", "init_args": {...}}`, plain types only."""


def class_path(obj: object) -> str:
    """The importable path of an object's class."""
    return f"{type(obj).__module__}.{type(obj).__qualname__}"


def describe(obj: object) -> Spec:
    """The spec of an object that keeps every constructor argument as an attribute of the same name."""
    names = inspect.signature(type(obj)).parameters
    return {"class_path": class_path(obj), "init_args": {name: getattr(obj, name) for name in names}}


def build(spec: Mapping[str, Any]) -> Any:
    """Make the object that a spec describes.

    Raises:
        CheckpointError: the class cannot be imported here, or does not take these arguments.
    """
    path = spec["class_path"]
    module, _, name = path.rpartition(".")
    try:
        return getattr(import_module(module), name)(**spec["init_args"])
    except (ImportError, AttributeError, ValueError) as error:
        raise CheckpointError(f"{path} cannot be imported ({error}); install the package that has it") from error
    except TypeError as error:
        raise CheckpointError(
            f"{path} does not take the saved settings ({error}); it was saved by another version, train it again"
        ) from error
