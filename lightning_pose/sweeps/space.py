"""The search space of a sweep file: what each setting may be, and when it is searched at all."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Container, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
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
    "Config",
    "Parameter",
    "Settings",
    "check_when",
    "draw_values",
    "list_grid",
    "name_classes",
    "normalize_key",
    "parse_space",
    "suggest_name",
]

Scalar = str | int | float | bool | None
Settings = Mapping[str, Any]
"""Values as YAML has them, of settings by dotted name or of a whole config."""
Config = dict[str, Any]
"""Such values that may be changed."""

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
    choices: Mapping[Scalar, object] | None = None
    when: Mapping[str, tuple[object, ...]] = field(default_factory=dict)

    def active(self, values: Settings) -> bool:
        """Whether it is searched, given the values of the parameters before it."""
        return all(key in values and values[key] in wanted for key, wanted in self.when.items())

    def draw(self, trial: Trial) -> object:
        """A value that Optuna suggests, as the config has it."""
        if self.choices is not None:
            return self.choices[trial.suggest_categorical(self.key, list(self.choices))]
        if self.kind == "int":
            return trial.suggest_int(self.key, int(self.low), int(self.high), step=int(self.step or 1), log=self.log)
        return self.value(trial.suggest_float(self.key, self.low, self.high, step=self.step, log=self.log))

    def grid_labels(self) -> list[Scalar]:
        """Every value, as Optuna stores it.

        Raises:
            ConfigError: there are infinitely many.
        """
        if self.choices is not None:
            return list(self.choices)
        if self.log or (self.kind == "float" and self.step is None):
            raise ConfigError(f"{self.key} has no step, so a grid has no end; give it a step, or choices")
        step = self.step or 1
        values = [self.low + i * step for i in range(math.floor((self.high - self.low) / step + 1e-9) + 1)]
        return [int(value) if self.kind == "int" else self._round_to_step(value) for value in values]

    def value(self, label: Scalar) -> object:
        """The config's value of a label that Optuna stores."""
        if self.choices is not None:
            return self.choices[label]
        return self._round_to_step(label) if self.step is not None and isinstance(label, float) else label

    def _round_to_step(self, number: float) -> float:
        """Undo what adding steps rounds: 0.1 + 0.1 + 0.1 is a little more than 0.3."""
        return min(float(f"{number:.12g}"), self.high)

    def example(self) -> list[object]:
        """Values to try against the config: all choices, or both ends."""
        if self.choices is not None:
            return list(self.choices.values())
        return [int(end) if self.kind == "int" else end for end in (self.low, self.high)]

    def describe(self) -> Config:
        """The parameter as JSON has it; a study is only continued with the same space."""
        content: Config = {"low": self.low, "high": self.high, "step": self.step, "log": self.log}
        if self.choices is not None:
            content = {"choices": list(self.choices)}
        return {"type": self.kind, **content, "when": {key: list(values) for key, values in self.when.items()}}


def parse_space(space: object) -> list[Parameter]:
    """Read the `space` of a sweep file, each parameter after those that its `when` names.

    Raises:
        ConfigError: an entry is malformed; the message names its key.
    """
    if not isinstance(space, Mapping) or not space:
        raise ConfigError(
            "space is empty; name a setting to search, such as model.units: {type: int, low: 8, high: 64}"
        )
    return _sort_by_when({normalize_key(key): _parse_parameter(normalize_key(key), space[key]) for key in space})


def normalize_key(key: object) -> str:
    """A setting's dotted name without `init_args`."""
    return str(key).replace(".init_args.", ".")


def _parse_parameter(key: str, entry: object) -> Parameter:
    if isinstance(entry, list):
        entry = {"choices": entry}
    if not isinstance(entry, Mapping):
        raise ConfigError(f"space.{key} is {entry!r}; give a list of choices, or {{type: int, low: 1, high: 9}}")
    for name in entry:
        if name not in FIELDS:
            raise ConfigError(f"space.{key} has no field {name!r}; {suggest_name(str(name), sorted(FIELDS))}")
    kind = entry.get("type", "categorical" if "choices" in entry else None)
    if kind not in KINDS:
        raise ConfigError(f"space.{key} has type {kind!r}; {suggest_name(str(kind), KINDS)}")
    when = _parse_when(key, entry.get("when"))
    if kind == "categorical":
        choices = entry.get("choices")
        if not isinstance(choices, list) or not choices:
            raise ConfigError(f"space.{key} is categorical with choices {choices!r}; give a list")
        labels = [json.dumps(choice) if isinstance(choice, list | dict) else choice for choice in choices]
        return Parameter(key, kind, choices=dict(zip(labels, choices, strict=True)), when=when)
    return _parse_range(key, kind, entry, when)


def _parse_range(key: str, kind: str, entry: Settings, when: Mapping[str, tuple[object, ...]]) -> Parameter:
    low, high = (_read_number(key, kind, name, entry.get(name)) for name in ("low", "high"))
    step = None if entry.get("step") is None else _read_number(key, kind, "step", entry["step"])
    log = bool(entry.get("log", False))
    if low > high:
        raise ConfigError(f"space.{key} has low {low} above high {high}; exchange them")
    if step is not None and step <= 0:
        raise ConfigError(f"space.{key} has step {step}; give a number above 0")
    if log and (low <= 0 or step is not None):
        raise ConfigError(f"space.{key} has log with low {low} and step {step}; give a low above 0 and no step")
    return Parameter(key, kind, low, high, step, log, when=when)


def _read_number(key: str, kind: str, name: str, value: object) -> float:
    """A number of a range, also where YAML 1.1 reads it as text, as 1e-4."""
    number = value
    if isinstance(value, str):
        with suppress(ValueError):
            number = float(value)
    whole = kind == "int"
    if isinstance(number, bool) or not isinstance(number, int if whole else int | float) or not math.isfinite(number):
        raise ConfigError(f"space.{key} has {name} {number!r}; give a {'whole ' * whole}number")
    return number if whole else float(number)


def _parse_when(key: str, when: object) -> dict[str, tuple[object, ...]]:
    if when is None:
        return {}
    if not isinstance(when, Mapping):
        raise ConfigError(f"space.{key} has when {when!r}; give the parameter and its value, as {{model.cell: lstm}}")
    return {normalize_key(k): tuple(wanted) if isinstance(wanted, list) else (wanted,) for k, wanted in when.items()}


def check_when(space: Sequence[Parameter]) -> None:
    """Refuse a `when` that no trial could fulfil.

    Raises:
        ConfigError: it names a value that is none of the other parameter's choices.
    """
    choices = {parameter.key: list(parameter.choices.values()) for parameter in space if parameter.choices}
    for parameter in space:
        for key, wanted in parameter.when.items():
            for value in wanted:
                if key in choices and value not in choices[key]:
                    raise ConfigError(
                        f"space.{parameter.key} has when {key} is {value!r}; {suggest_name(str(value), choices[key])}"
                    )


def _sort_by_when(parameters: dict[str, Parameter]) -> list[Parameter]:
    """Each parameter after those that its `when` names, otherwise in the order of the file."""
    for name, parameter in parameters.items():
        when = dict(parameter.when)
        for key, wanted in when.items():
            if key not in parameters:
                raise ConfigError(
                    f"space.{name} has when {key}, which is not searched; {suggest_name(key, parameters)}"
                )
            if list(wanted) in (parameters[key].choices or {}).values():
                when[key] = (list(wanted),)  # one choice that is a list, and not several
        parameters[name] = replace(parameter, when=when)
    ordered: list[Parameter] = []
    left = list(parameters.values())
    while left:
        known = {parameter.key for parameter in ordered}
        ready = next((parameter for parameter in left if known.issuperset(parameter.when)), None)
        if ready is None:
            raise ConfigError(f"space.{left[0].key} waits for itself through its when; break the circle")
        ordered.append(ready)
        left.remove(ready)
    return ordered


def name_classes(space: Sequence[Parameter], known: Container[str]) -> list[Parameter]:
    """The space with classes renamed to their `class_path`, as `data.extractor.class_path` for `data.extractor`."""
    names = {
        parameter.key: f"{parameter.key}.class_path"
        for parameter in space
        if f"{parameter.key}.class_path" in known and all(isinstance(value, str) for value in parameter.example())
    }
    return [
        replace(p, key=names.get(p.key, p.key), when={names.get(k, k): wanted for k, wanted in p.when.items()})
        for p in space
    ]


def draw_values(trial: Trial, space: Sequence[Parameter]) -> Config:
    """The values of one trial by key; parameters whose `when` does not hold are left out."""
    values: Config = {}
    for parameter in space:
        if parameter.active(values):
            values[parameter.key] = parameter.draw(trial)
    return values


def list_grid(space: Sequence[Parameter], seed: int = 0) -> list[dict[str, Scalar]]:
    """Every combination once, in a shuffled order, so that the first few are spread over the space.

    Combinations that differ only in a parameter whose `when` does not hold are one.

    Returns:
        Optuna's labels by key.

    Raises:
        ConfigError: a parameter has no step, or there are more combinations than anyone runs.
    """
    labels = [parameter.grid_labels() for parameter in space]
    size = math.prod(map(len, labels))
    if size > LARGEST_GRID:
        raise ConfigError(f"the grid has {size} combinations; take larger steps, or another sampler than grid")
    points = {}
    for combination in itertools.product(*labels):
        point: dict[str, Scalar] = {}
        values: Config = {}
        for parameter, label in zip(space, combination, strict=True):
            if parameter.active(values):
                point[parameter.key], values[parameter.key] = label, parameter.value(label)
        points[json.dumps(point)] = point
    return [points[name] for name in np.random.default_rng(seed).permutation(sorted(points)).tolist()]


def suggest_name(name: str, known: Iterable[object]) -> str:
    """The remedy for a mistyped name: the nearest known one, or all of them."""
    names = list(map(str, known))
    near = get_close_matches(name, names, n=1, cutoff=0.5)
    if not near:  # a dotted name may be right in its last part alone
        near = [key for key in names if key.rpartition(".")[2] == name.rpartition(".")[2]]
    if near:
        return f"did you mean {near[0]}?"
    return f"choose one of {', '.join(names)}" if len(names) <= 20 else "see `python -m lightning_pose fit --help`"


BASE, SEED, SCENE = "base", "seed_everything", "data.root"
"""Parameters with a special meaning: which base config a trial has, the seed, and the folder of the scene."""

MEASURES = {
    None: ("val/", "cost/"),
    "test": ("val/", "test/", "cost/", "baseline/", "train/"),
    "features": ("features/",),
}
"""Prefixes of the metrics that trials have, by the `measure` of the sweep file."""
