"""The plan of a sweep: its file, read and checked against its base config, before anything is trained."""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lightning_pose.cli import PoseCLI
from lightning_pose.errors import ConfigError
from lightning_pose.summary import summarize_errors
from lightning_pose.sweeps.space import Parameter, nearest, parse_space
from lightning_pose.tracking import default_tracking_uri

__all__ = ["Objective", "Plan", "read_plan"]

FIELDS = ("base", "objective", "sampler", "pruner", "n_trials", "seed", "settings", "space")
COSTS = ("cost/parameters", "cost/train_seconds")
MEASURED = [f"val/{name}" for name in ("loss", *summarize_errors(np.zeros(1), np.zeros(1)))]


@dataclass(frozen=True)
class Objective:
    """A metric of the validation frames, or a cost, and whether more of it is better."""

    metric: str
    maximize: bool = False


@dataclass(frozen=True)
class Plan:
    """What a sweep does.

    Attributes:
        file: the sweep file.
        base: the base config.
        objectives: one or several.
        sampler: name and options.
        pruner: name and options.
        n_trials: how many a command runs, if it does not say so itself.
        seed: of the sampler.
        settings: what is fixed for all trials on top of the base config, by dotted key.
        space: what is searched.
        resolved: the whole config with `settings`, defaults included.
    """

    file: Path
    base: Path
    objectives: tuple[Objective, ...]
    sampler: Mapping[str, Any]
    pruner: Mapping[str, Any]
    n_trials: int | None
    seed: int
    settings: Mapping[str, Any]
    space: tuple[Parameter, ...]
    resolved: Mapping[str, Any]

    @property
    def scene(self) -> str:
        """Name of the scene that its trials train on: the folder's, or `room` for synthetic ones."""
        data = self.resolved["data"]["init_args"]
        roots = [data["root"]] if data.get("root") else data.get("train_scenes") or []
        return "+".join(Path(root).name for root in roots) or "room"

    @property
    def tracking(self) -> tuple[str, str]:
        """MLflow's address and experiment."""
        logger = self.resolved["trainer"]["logger"]["init_args"]
        return logger["tracking_uri"] or default_tracking_uri(logger["root"]), logger["experiment_name"]

    def arguments(self, values: Mapping[str, Any]) -> list[str]:
        """The command line of a trial, without its verb: base config, settings, and the trial's values."""
        return ["--config", str(self.base), *_options({**self.settings, **values})]

    def config(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """The base config with settings and values put in, as a config file has it."""
        config = _read_yaml(self.base, "base config")
        full = _Config(self.arguments(values)).config.as_dict()
        for key, value in {**self.settings, **values}.items():
            _put(config, full, key.split("."), value)
        return config

    def describe(self) -> dict[str, str]:
        """What a study cannot change between two commands: the space, the objectives, and what the trials share."""
        fixed = {"config": _read_yaml(self.base, "base config"), "settings": dict(self.settings)}
        return {
            "search space": json.dumps({p.key: p.describe() for p in self.space}, sort_keys=True),
            "objectives": json.dumps([[o.metric, o.maximize] for o in self.objectives]),
            "base config or settings": json.dumps(fixed, sort_keys=True, default=str),
        }


class _Config(PoseCLI):
    """A command line that is parsed and checked, and then not run."""

    def __init__(self, args: list[str]) -> None:
        super().__init__(args, run=False)

    def _set_seed(self) -> None:
        """Not yet."""

    def instantiate_classes(self) -> None:
        """Nothing."""


def read_plan(file: Path, overrides: Mapping[str, Any]) -> Plan:
    """Read a sweep file and check every part of it.

    Args:
        file: YAML.
        overrides: settings of the command line, which win over the file's.

    Raises:
        ConfigError: the file or its base config is missing or malformed, a key is unknown, or a value is refused.
    """
    raw = _read_yaml(file, "sweep file")
    for field in raw:
        if field not in FIELDS:
            raise ConfigError(f"{file} has an unknown entry {field!r}; {nearest(str(field), FIELDS)}")
    base = _find_base(file, raw.get("base"))
    settings = {str(key).replace(".init_args.", "."): value for key, value in (raw.get("settings") or {}).items()}
    settings |= overrides
    space = parse_space(raw.get("space"))
    settings, resolved = _check_keys(base, settings, space)
    plan = Plan(
        file=file,
        base=base,
        objectives=_parse_objectives(raw.get("objective", "val/loss")),
        sampler=_named(raw.get("sampler", "tpe"), "sampler"),
        pruner=_named(raw.get("pruner", "default"), "pruner"),
        n_trials=_whole(raw.get("n_trials"), "n_trials"),
        seed=_whole(raw.get("seed"), "seed") or 0,
        settings=settings,
        space=tuple(space),
        resolved=resolved,
    )
    if not str((resolved["trainer"]["logger"] or {}).get("class_path", "")).endswith("MLflowLogger"):
        raise ConfigError(f"{base} has another trainer.logger, but a sweep keeps its trials in MLflow; leave it out")
    return plan


def _read_yaml(file: Path, what: str) -> dict[str, Any]:
    try:
        content = yaml.safe_load(file.read_text())
    except OSError as error:
        raise ConfigError(f"the {what} {file} cannot be read ({error.strerror}); check the path") from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"the {what} {file} is not YAML ({' '.join(str(error).split())}); correct it") from error
    if not isinstance(content, dict):
        raise ConfigError(f"the {what} {file} is no mapping; see sweeps/surf_cnn.yaml")
    return content


def _find_base(file: Path, base: Any) -> Path:
    if not isinstance(base, str):
        raise ConfigError(f"{file} names no base config; add a line such as `base: configs/surf_cnn.yaml`")
    for folder in (file.parent, Path(), Path(__file__).parents[2]):
        if (folder / base).is_file():
            return folder / base
    raise ConfigError(f"{file} names the base config {base}, which is not there; give its path from the sweep file")


def _named(entry: Any, what: str) -> dict[str, Any]:
    """`tpe` or `{name: tpe, n_startup_trials: 5}`."""
    named = {"name": entry} if isinstance(entry, str) else entry
    if not isinstance(named, dict) or not isinstance(named.get("name"), str):
        raise ConfigError(f"{what} is {entry!r}; give a name, or {{name: ..., option: ...}}")
    return named


def _whole(value: Any, what: str) -> int | None:
    if value is not None and (not isinstance(value, int) or isinstance(value, bool) or value < 0):
        raise ConfigError(f"{what} is {value!r}; give a whole number, 0 or more")
    return value


def _parse_objectives(raw: Any) -> tuple[Objective, ...]:
    entries = raw if isinstance(raw, list) else [raw]
    if not entries:
        raise ConfigError("objective is empty; give val/loss, or leave it out")
    return tuple(_parse_objective(entry) for entry in entries)


def _parse_objective(entry: Any) -> Objective:
    named = {"metric": entry} if isinstance(entry, str) else entry
    if not isinstance(named, dict) or not isinstance(named.get("metric"), str) or named.keys() - {"metric", "goal"}:
        raise ConfigError(f"objective is {entry!r}; give a metric, or {{metric: val/loss, goal: minimize}}")
    metric = named["metric"]
    if metric.startswith(("test/", "baseline/")):
        raise ConfigError(f"objective {metric} is measured on test frames, which must not choose; take its val/ name")
    if metric not in (*MEASURED, *COSTS):
        raise ConfigError(f"objective {metric} is not known; {nearest(metric, [*MEASURED, *COSTS])}")
    goal = named.get("goal", "maximize" if "recall" in metric else "minimize")
    if goal not in ("minimize", "maximize"):
        raise ConfigError(f"objective {metric} has goal {goal!r}; give minimize or maximize")
    return Objective(metric, goal == "maximize")


def _check_keys(
    base: Path, settings: Mapping[str, Any], space: Sequence[Parameter]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Every key exists, in the base config or under a class that is searched, and has values of the right type.

    Returns:
        The settings, a class by the name of its `class_path`, and the whole config with them.
    """
    cli = _Config(["--config", str(base)])
    known = _keys(cli.config.as_dict())
    for key in settings:
        _check_known(key, known, "")
    settings = {
        f"{key}.class_path" if isinstance(value, str) and f"{key}.class_path" in known else key: value
        for key, value in settings.items()
    }
    resolved = cli.parser.parse_args(["--config", str(base), *_options(settings)]).as_dict()
    known |= _keys(resolved)
    classes = [p for p in space if p.key.endswith(".class_path")]
    for parameter in classes:
        for choice in parameter.example():
            chosen = ["--config", str(base), *_options({**settings, parameter.key: choice})]
            known |= _keys(cli.parser.parse_args(chosen).as_dict())
    for parameter in space:
        _check_known(parameter.key, known, "space.")
        if parameter.when or classes:
            continue  # it may suit some trials alone, which say so
        for value in parameter.example():
            try:
                cli.parser.parse_args(["--config", str(base), *_options({**settings, parameter.key: value})])
            except ConfigError as error:
                raise ConfigError(f"space.{parameter.key} cannot be {value!r}: {error}") from error
    return settings, resolved


def _check_known(key: str, known: Mapping[str, Any], where: str) -> None:
    parts = key.split(".")
    above = [".".join(parts[:n]) for n in range(2, len(parts))]
    # What is below a setting that is null by default is the parser's to judge.
    if key not in known and not any(name in known and known[name] is None for name in above):
        raise ConfigError(f"{where}{key} is no setting of the base config; {nearest(key, list(known))}")


def _keys(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Every setting by its dotted name without `init_args`, and every group of settings."""
    keys: dict[str, Any] = {}
    for name, value in config.items():
        key = prefix if name == "init_args" else f"{prefix}.{name}" if prefix else str(name)
        if isinstance(value, Mapping):
            keys |= {key: value} if name != "init_args" else {}
            keys |= _keys(value, key)
        else:
            keys[key] = value
    return keys


def _options(values: Mapping[str, Any]) -> list[str]:
    """Settings as words of a command line; a class before its arguments, because it drops those it does not have."""
    ordered = sorted(values.items(), key=lambda item: not item[0].endswith(".class_path"))
    return [
        f"--{key.removesuffix('.class_path')}={value if isinstance(value, str) else json.dumps(value)}"
        for key, value in ordered
    ]


def _put(config: dict[str, Any], full: Mapping[str, Any], parts: Sequence[str], value: Any) -> None:
    """Set one value in a config file's content, through the `init_args` that the whole config has on the way."""
    head, *rest = parts
    if "init_args" in full and head != "class_path":
        config.setdefault("class_path", full["class_path"])
        config = config.setdefault("init_args", {})
        full = full["init_args"]
    if not rest:
        if head == "class_path" and "init_args" in config:
            config["init_args"] = {k: v for k, v in config["init_args"].items() if k in full.get("init_args", {})}
        config[head] = copy.deepcopy(value)
        return
    if not isinstance(config.get(head), dict):
        config[head] = {}
    _put(config[head], full.get(head) or {}, rest, value)
