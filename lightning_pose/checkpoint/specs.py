"""Objects in checkpoints as plain specs: a class path and arguments.

A spec is what config files write: `describe_object` makes it from an object, `build_object` the object from it.

A checkpoint may come from a stranger, so that no class in it is imported unless this package has it, as an
architecture, a feature extractor or a data module, or the user allows it by name.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterable, Mapping
from importlib import import_module
from typing import Any

from lightning_pose.checkpoint.class_paths import resolve_class_path
from lightning_pose.checkpoint.setting_types import find_mistyped
from lightning_pose.errors import CheckpointError, PoseError

__all__ = ["Spec", "build_object", "check_specs", "class_path", "describe_object", "find_class_paths"]

Spec = dict[str, Any]
"""`{"class_path": "package.module.Class", "init_args": {...}}`, plain types only."""

MOVED_SETTINGS = {("lightning_pose.models.LandmarkMap", "camera"): "camera"}
"""Settings of a model, by its class and name, that are settings of the data now, to their name there."""


def class_path(obj: object) -> str:
    """The path by which users import an object's class: its name in the outermost package that exports it.

    `lightning_pose.models.SurfLSTM`, not `lightning_pose.models.surf_lstm.SurfLSTM`, so that files stay readable
    when a module moves. A class that no package exports is named by its module.
    """
    cls = type(obj)
    parts = cls.__module__.split(".")
    for length in range(2, len(parts)):  # not the top package, which exports lazily
        package = ".".join(parts[:length])
        if getattr(sys.modules.get(package), cls.__qualname__, None) is cls:
            return f"{package}.{cls.__qualname__}"
    return f"{cls.__module__}.{cls.__qualname__}"


def describe_object(obj: object) -> Spec:
    """Make the spec of an object that keeps every constructor argument as an attribute of the same name."""
    names = inspect.signature(type(obj)).parameters
    return {"class_path": class_path(obj), "init_args": {name: getattr(obj, name) for name in names}}


BASES = {
    "lightning_pose.models": "PoseModule",
    "lightning_pose.features": "FeatureExtractor",
    "lightning_pose.data": "SceneDataModule",
}
"""Packages whose classes a checkpoint may name, and the class that each of these must be a subclass of."""


def build_object(spec: Mapping[str, Any], allow: str | Iterable[str] = (), package: str | None = None) -> Any:
    """Make the object that a spec describes.

    Args:
        spec: of a checkpoint.
        allow: class paths, or packages, of the user's own classes that the spec may name.
        package: of `BASES`, whose base class the object must have; any of them by default.

    Raises:
        CheckpointError: the class is neither this package's nor allowed, it cannot be imported here, or does not
            take these arguments.
    """
    spec = _check_spec(spec, _list_allowed(allow))
    path = spec["class_path"]
    cls = _import_class(path, (package,) if package else tuple(BASES))
    mistyped = find_mistyped(cls, spec["init_args"])
    if mistyped is not None:
        value = str(spec["init_args"][mistyped])[:80]
        raise CheckpointError(
            f"the checkpoint has {mistyped} = {value} for {path}, which is of another type; train again"
        )
    try:
        return cls(**spec["init_args"])
    except PoseError:
        raise
    except Exception as error:  # settings of any kind may be in the file, and each class fails on them in its own way
        raise CheckpointError(
            f"{path} does not take the saved settings ({error}); it was saved by another version, train it again"
        ) from error


def check_specs(specs: object, allow: str | Iterable[str] = ()) -> dict[str, Spec | None]:
    """Check the specs of `model` and `data` in a checkpoint, without importing a class that is not allowed.

    Args:
        specs: a checkpoint's `lightning_pose`.
        allow: as for `build_object`.

    Returns:
        Specs of `model` and of `data` with its `extractor`, without anything else; `data` is None where there was no
        data module.

    Raises:
        CheckpointError: as `build_object`, or a spec is malformed.
    """
    if not isinstance(specs, Mapping) or "model" not in specs:
        raise CheckpointError("the checkpoint does not say which architecture it holds; train it again")
    allow = _list_allowed(allow)
    model = _check_spec(specs["model"], allow)
    _import_class(model["class_path"], ("lightning_pose.models",))
    moved = _take_moved_settings(model)
    data = specs.get("data")
    if data is None:
        return {"model": model, "data": None}
    arguments = data.get("init_args") if isinstance(data, Mapping) else None
    if not isinstance(arguments, Mapping) or "extractor" not in arguments:
        raise CheckpointError("the checkpoint does not say which features it reads; train it again")
    arguments = {**arguments, **moved}
    extractor = _check_spec(arguments["extractor"], allow)
    _import_class(extractor["class_path"], ("lightning_pose.features",))
    others = {name: value for name, value in arguments.items() if name != "extractor"}
    data = _check_spec({"class_path": data.get("class_path"), "init_args": others}, allow)
    _import_class(data["class_path"], ("lightning_pose.data",))
    data["init_args"]["extractor"] = extractor
    return {"model": model, "data": data}


def _take_moved_settings(model: Spec) -> Spec:
    """Take out of a model's spec what is a setting of the data now."""
    names = [(name, new) for (path, name), new in MOVED_SETTINGS.items() if path == model["class_path"]]
    return {new: model["init_args"].pop(name) for name, new in names if name in model["init_args"]}


CLASS_SETTINGS = ("class_path", "model", "data", "extractor", "backbone")
"""Names of settings whose value may be a class path."""


def find_class_paths(settings: object) -> list[str]:
    """All texts that nested settings give for one of `CLASS_SETTINGS`."""
    found: list[str] = []
    if isinstance(settings, Mapping):
        found = [text for name, text in settings.items() if name in CLASS_SETTINGS and isinstance(text, str)]
        settings = list(settings.values())
    if isinstance(settings, list):
        found += [text for inner in settings for text in find_class_paths(inner)]
    return found


def _list_allowed(allow: str | Iterable[str]) -> tuple[str, ...]:
    """Allowed class paths, of which one may stand alone, by their names of today."""
    return tuple(map(resolve_class_path, (allow,) if isinstance(allow, str) else allow))


def _check_spec(spec: object, allow: tuple[str, ...]) -> Spec:
    """A spec's class path and arguments, checked; its class path is today's.

    Raises:
        CheckpointError: as `check_specs`.
    """
    if not isinstance(spec, Mapping) or not isinstance(spec.get("class_path"), str):
        raise CheckpointError(f"the checkpoint holds {str(spec)[:80]!r} in place of a class and its settings")
    path, arguments = resolve_class_path(spec["class_path"]), spec.get("init_args", {})
    if not isinstance(arguments, Mapping) or not all(isinstance(name, str) for name in arguments):
        raise CheckpointError(f"the checkpoint holds no settings of {path}; train it again")
    if _mentions_class(arguments):
        raise CheckpointError(f"the checkpoint's settings of {path} name further classes, as `fit` never writes them")
    backbone = arguments.get("backbone")
    for named in (path, backbone):
        if isinstance(named, str) and not _is_trusted(named, named is backbone, allow):
            raise CheckpointError(
                f"the checkpoint names {named}, which is not this package's; reading it would run code from there. "
                f"If you trust it, give --allow {named}, or in Python allow=[{named!r}]"
            )
    return {"class_path": path, "init_args": dict(arguments)}


def _mentions_class(value: object) -> bool:
    """Whether nested settings hold the spec of a class, or a dotted name, which the command line would take for one."""
    if isinstance(value, Mapping):
        return any(name == "class_path" or "." in str(name) or _mentions_class(inner) for name, inner in value.items())
    return isinstance(value, list | tuple) and any(_mentions_class(inner) for inner in value)


def _is_trusted(path: str, is_backbone: bool, allow: tuple[str, ...]) -> bool:
    """Whether a checkpoint may name this class, or this network of a `backbone` setting."""
    if any(path == name or path.startswith(f"{name}.") for name in allow):
        return True
    if is_backbone:
        return "." not in path or _is_torchvision_network(path)
    return any(path.startswith(f"{package}.") for package in BASES)


def _is_torchvision_network(path: str) -> bool:
    """Whether a path names one of the networks that torchvision lists."""
    if not re.fullmatch(r"torchvision\.models(\.\w+)+", path):
        return False
    from torchvision import models  # a second to import, and few need it

    module, _, name = path.rpartition(".")
    return name in models.list_models() and models.get_model_builder(name).__module__.startswith(module)


def _import_class(path: str, packages: Iterable[str]) -> type:
    """Import a class that must have the base class of one of these packages.

    Raises:
        CheckpointError: it cannot be imported, or is something else.
    """
    module, _, name = path.rpartition(".")
    try:
        found = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise CheckpointError(f"{path} cannot be imported ({error}); install the package that has it") from error
    bases = tuple(getattr(import_module(package), BASES[package]) for package in packages)
    if not isinstance(found, type) or not issubclass(found, bases):
        raise CheckpointError(f"{path} is no {' or '.join(base.__name__ for base in bases)}, as `fit` would name it")
    return found
