"""The search space of a sweep file: what each setting may be, and when it is searched at all."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

import numpy as np

from lightning_pose.errors import ConfigError

if TYPE_CHECKING:
    from optuna import Trial

__all__ = [
    "BASE",
    "MEASURES",
    "SCENE",
    "SEED",
    "Parameter",
    "by_class_path",
    "check_when",
    "draw",
    "grid",
    "nearest",
    "parse_space",
]

Scalar = str | int | float | bool | None

KINDS = ("float", "int", "categorical")
FIELDS = {"type", "low", "high", "step", "log", "choices", "when"}
LARGEST_GRID = 10_000


@dataclass(frozen=True)
class Parameter:
    """One setting that is searched.

    Attributes:
        key: dotted name in the config, without `init_args`.
        kind: `float`, `int` or `categorical`.
        low: smallest value; numbers only.
        high: largest value, included.
        step: distance of neighbouring values, None for any value (float) or 1 (int).
        log: search the logarithm.
        choices: of a categorical one, by the name that Optuna stores: lists by their JSON.
        when: searched only where these other parameters have one of these values.
    """

    key: str
    kind: str
    low: float = 0
    high: float = 0
    step: float | None = None
    log: bool = False
    choices: Mapping[Scalar, Any] | None = None
    when: Mapping[str, tuple[Any, ...]] | None = None

    def active(self, values: Mapping[str, Any]) -> bool:
        """Whether it is searched, given the values of the parameters before it."""
        return all(key in values and values[key] in wanted for key, wanted in (self.when or {}).items())

    def draw(self, trial: Trial) -> Any:
        """A value of Optuna's choosing."""
        if self.choices is not None:
            return self.choices[trial.suggest_categorical(self.key, list(self.choices))]
        if self.kind == "int":
            return trial.suggest_int(self.key, int(self.low), int(self.high), step=int(self.step or 1), log=self.log)
        return self.value(trial.suggest_float(self.key, self.low, self.high, step=self.step, log=self.log))

    def grid_labels(self) -> list[Scalar]:
        """Every value, as Optuna stores it.

        Raises:
            ConfigError: there are infinitely many, or their number is not meant.
        """
        if self.choices is not None:
            return list(self.choices)
        if self.log or (self.kind == "float" and self.step is None):
            raise ConfigError(f"{self.key} has no step, so a grid has no end; give it a step, or choices")
        step = self.step or 1
        values = [self.low + i * step for i in range(math.floor((self.high - self.low) / step + 1e-9) + 1)]
        return [int(value) if self.kind == "int" else self.value(float(value)) for value in values]

    def value(self, label: Scalar) -> Any:
        """What a stored label stands for in the config."""
        if self.choices is not None:
            return self.choices[label]
        if self.step is None or not isinstance(label, float):
            return label
        return min(float(f"{label:.12g}"), self.high)  # three steps of 0.1 are 0.3 to a reader, and not beyond 0.3

    def example(self) -> list[Any]:
        """Values to try against the config: all choices, or both ends."""
        if self.choices is not None:
            return list(self.choices.values())
        return [int(end) if self.kind == "int" else end for end in (self.low, self.high)]

    def describe(self) -> dict[str, Any]:
        """Plain and comparable: studies are continued with the same space alone."""
        if self.choices is not None:
            told: dict[str, Any] = {"type": self.kind, "choices": list(self.choices)}
        else:
            told = {"type": self.kind, "low": self.low, "high": self.high, "step": self.step, "log": self.log}
        return told | {"when": {key: list(values) for key, values in (self.when or {}).items()}}


def parse_space(space: Any) -> list[Parameter]:
    """Read the `space` of a sweep file, each parameter after those that its `when` names.

    Raises:
        ConfigError: an entry is malformed; the message names its key.
    """
    if not isinstance(space, Mapping) or not space:
        raise ConfigError(
            "space is empty; name a setting to search, such as model.units: {type: int, low: 8, high: 64}"
        )
    parameters = {}
    for name, entry in space.items():
        key = str(name).replace(".init_args.", ".")
        parameters[key] = _parse(key, entry)
    return _ordered(parameters)


def _parse(key: str, entry: Any) -> Parameter:
    if isinstance(entry, list):
        entry = {"choices": entry}
    if not isinstance(entry, Mapping):
        raise ConfigError(f"space.{key} is {entry!r}; give a list of choices, or {{type: int, low: 1, high: 9}}")
    for field in entry:
        if field not in FIELDS:
            raise ConfigError(f"space.{key} has no field {field!r}; {nearest(str(field), sorted(FIELDS))}")
    kind = entry.get("type", "categorical" if "choices" in entry else None)
    if kind not in KINDS:
        raise ConfigError(f"space.{key} has type {kind!r}; {nearest(str(kind), KINDS)}")
    when = _parse_when(key, entry.get("when"))
    if kind == "categorical":
        choices = entry.get("choices")
        if not isinstance(choices, list) or not choices:
            raise ConfigError(f"space.{key} is categorical with choices {choices!r}; give a list")
        return Parameter(key, kind, choices={_label(choice): choice for choice in choices}, when=when)
    return _parse_range(key, kind, entry, when)


def _parse_range(key: str, kind: str, entry: Mapping[str, Any], when: Mapping[str, tuple[Any, ...]]) -> Parameter:
    whole = int if kind == "int" else (int, float)
    numbers = {name: _number(entry.get(name)) for name in ("low", "high", "step")}
    for name, number in numbers.items():
        if name == "step" and number is None:
            continue
        if isinstance(number, bool) or not isinstance(number, whole) or not math.isfinite(number):
            raise ConfigError(f"space.{key} has {name} {number!r}; give a {'whole ' * (kind == 'int')}number")
    low, high, step, log = numbers["low"], numbers["high"], numbers["step"], bool(entry.get("log", False))
    if low > high:
        raise ConfigError(f"space.{key} has low {low} above high {high}; exchange them")
    if step is not None and step <= 0:
        raise ConfigError(f"space.{key} has step {step}; give a number above 0")
    if log and (low <= 0 or step is not None):
        raise ConfigError(f"space.{key} has log with low {low} and step {step}; give a low above 0 and no step")
    as_kind = int if kind == "int" else float
    return Parameter(key, kind, as_kind(low), as_kind(high), None if step is None else as_kind(step), log, when=when)


def _number(value: Any) -> Any:
    """YAML 1.1 reads 1e-4 as text."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _parse_when(key: str, when: Any) -> dict[str, tuple[Any, ...]]:
    if when is None:
        return {}
    if not isinstance(when, Mapping):
        raise ConfigError(f"space.{key} has when {when!r}; give the parameter and its value, as {{model.cell: lstm}}")
    return {
        str(name).replace(".init_args.", "."): tuple(wanted) if isinstance(wanted, list) else (wanted,)
        for name, wanted in when.items()
    }


def check_when(space: Sequence[Parameter]) -> None:
    """Refuse a `when` that no trial could fulfil.

    Raises:
        ConfigError: it names a value that is none of the other parameter's choices.
    """
    choices = {parameter.key: list(parameter.choices.values()) for parameter in space if parameter.choices}
    for parameter in space:
        for key, wanted in (parameter.when or {}).items():
            for value in wanted:
                if key in choices and value not in choices[key]:
                    raise ConfigError(
                        f"space.{parameter.key} has when {key} is {value!r}; {nearest(str(value), choices[key])}"
                    )


def _label(choice: Any) -> Scalar:
    return choice if choice is None or isinstance(choice, str | int | float | bool) else json.dumps(choice)


def _ordered(parameters: dict[str, Parameter]) -> list[Parameter]:
    for name, parameter in parameters.items():
        when = dict(parameter.when or {})
        for key, wanted in when.items():
            if key not in parameters:
                raise ConfigError(f"space.{name} has when {key}, which is not searched; {nearest(key, parameters)}")
            if list(wanted) in (parameters[key].choices or {}).values():
                when[key] = (list(wanted),)  # one choice that is a list, and not several
        parameters[name] = replace(parameter, when=when)
    ordered: list[Parameter] = []
    left = list(parameters.values())
    while left:
        known = {parameter.key for parameter in ordered}
        ready = [parameter for parameter in left if known.issuperset(parameter.when or ())]
        if not ready:
            raise ConfigError(f"space.{left[0].key} waits for itself through its when; break the circle")
        # One at a time keeps the order of the file.
        ordered.append(ready[0])
        left.remove(ready[0])
    return ordered


def by_class_path(space: Sequence[Parameter], known: Container[str]) -> list[Parameter]:
    """The space with classes by the name of their `class_path`, as `data.extractor.class_path` for `data.extractor`."""
    names = {
        parameter.key: f"{parameter.key}.class_path"
        for parameter in space
        if f"{parameter.key}.class_path" in known and all(isinstance(value, str) for value in parameter.example())
    }
    return [
        replace(p, key=names.get(p.key, p.key), when={names.get(k, k): wanted for k, wanted in (p.when or {}).items()})
        for p in space
    ]


def draw(trial: Trial, space: Sequence[Parameter]) -> dict[str, Any]:
    """The values of one trial by key; parameters whose `when` does not hold are left out."""
    values: dict[str, Any] = {}
    for parameter in space:
        if parameter.active(values):
            values[parameter.key] = parameter.draw(trial)
    return values


def grid(space: Sequence[Parameter], seed: int = 0) -> list[dict[str, Scalar]]:
    """Every combination once, in a shuffled order, so that the first few are spread over the space.

    Combinations that differ only in a parameter that is not searched there are one.

    Returns:
        Optuna's labels by key.

    Raises:
        ConfigError: a parameter has no step, or there are more combinations than anyone runs.
    """
    size = math.prod(len(parameter.grid_labels()) for parameter in space)
    if size > LARGEST_GRID:
        raise ConfigError(f"the grid has {size} combinations; take larger steps, or another sampler than grid")
    cells = {json.dumps(cell): cell for cell in _cells(space)}
    return [cells[name] for name in np.random.default_rng(seed).permutation(sorted(cells)).tolist()]


def _cells(space: Sequence[Parameter]) -> Iterator[dict[str, Scalar]]:
    for labels in itertools.product(*(parameter.grid_labels() for parameter in space)):
        cell: dict[str, Scalar] = {}
        values: dict[str, Any] = {}
        for parameter, label in zip(space, labels, strict=True):
            if parameter.active(values):
                cell[parameter.key], values[parameter.key] = label, parameter.value(label)
        yield cell


def nearest(name: str, known: Iterable[Any]) -> str:
    """The remedy for a mistyped name."""
    known = list(map(str, known))
    near = get_close_matches(name, known, n=1, cutoff=0.5)
    if not near:  # a dotted name may be right in its last part alone
        last = name.rpartition(".")[2]
        near = [key for key in known if key.rpartition(".")[2] == last][:1]
    if near:
        return f"did you mean {near[0]}?"
    return f"choose one of {', '.join(known)}" if len(known) <= 20 else "see `python -m lightning_pose fit --help`"


BASE, SEED, SCENE = "base", "seed_everything", "data.root"
"""Parameters with a part of their own: which base config a trial has, what is averaged over, and a folder."""

MEASURES = {
    None: ("val/", "cost/"),
    "test": ("val/", "test/", "cost/", "baseline/", "train/"),
    "features": ("features/",),
}
"""What trials measure, and the metrics that they have then."""
