"""The plan of a sweep: its file, read and checked against its base configs, before anything is trained."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lightning_pose.errors import ConfigError
from lightning_pose.metrics import catalog
from lightning_pose.paths import default_tracking_uri
from lightning_pose.sweeps.base_config import ParsedConfig, change_value, check_settings, read_yaml, write_options
from lightning_pose.sweeps.space import (
    BASE,
    MEASURES,
    Config,
    Parameter,
    Settings,
    check_when,
    normalize_key,
    parse_space,
    suggest_name,
)

__all__ = ["MEASURES", "Objective", "Plan", "read_plan"]

FIELDS = ("base", "objective", "sampler", "pruner", "n_trials", "seed", "settings", "space", "measure", "figure")
COSTS = tuple(f"cost/{name}" for name, cost in catalog.COSTS.items() if cost.objective)
MEASURED = ("val/loss", *(f"val/{name}" for name in catalog.ERRORS))
SCENES = (
    "data.root", "data.train_scenes", "data.test_scenes", "data.val_scenes", "data.ground_truth", "data.pgt",
    "data.room_seed", "data.train_rooms", "data.test_rooms",
)  # fmt: skip
"""What decides which frames a trial is judged on, and by which truth."""
FEATURES = ("features/count_median", "features/count_mean")


@dataclass(frozen=True)
class Objective:
    """A metric of the validation frames, or a cost, and whether more of it is better."""

    metric: str
    maximize: bool = False


@dataclass(frozen=True)
class Plan:
    """A sweep file, read and checked.

    Attributes:
        file: the sweep file.
        bases: the base configs by name; where there are several, the parameter `base` names that of a trial.
        objectives: one or several.
        sampler: name and options.
        pruner: name and options.
        n_trials: how many a command runs without `--n_trials`.
        seed: of the sampler.
        settings: what is fixed for all trials on top of the base config, by dotted key.
        space: what is searched.
        measure: `test` where trials measure the test frames too, which choose nothing; `features` where they measure
            features and train nothing; else None.
        figure: the file's `figure` entry as it is written, None where there is none; `studies.figure_spec` reads it.
        resolved: the first base's whole config with `settings`, defaults included.
    """

    file: Path
    bases: Mapping[str, Path]
    objectives: tuple[Objective, ...]
    sampler: Settings
    pruner: Settings
    n_trials: int | None
    seed: int
    settings: Settings
    space: tuple[Parameter, ...]
    measure: str | None
    figure: object
    resolved: Settings

    @property
    def scene(self) -> str:
        """Name of the scene that its trials train on: the folder's, or `room` for synthetic ones."""
        data = self.resolved["data"]["init_args"]
        searched = [p.example() for p in self.space if p.key == "data.root"]
        roots = [data["root"]] if data.get("root") else data.get("train_scenes") or []
        return "+".join(Path(str(root)).name for root in (searched[0] if searched else roots) if root) or "room"

    @property
    def system(self) -> str:
        """The architecture's name, or those of several."""
        return "+".join(self.bases) if len(self.bases) > 1 else self.resolved["model"]["class_path"].rpartition(".")[2]

    @property
    def comparable(self) -> bool:
        """Whether one trial can be the best: features are not better or worse, and scenes are not equally hard."""
        return self.measure != "features" and not any(p.key in SCENES for p in self.space)

    @property
    def tracking(self) -> tuple[str, str]:
        """MLflow's address and experiment."""
        logger = self.resolved["trainer"]["logger"]["init_args"]
        return logger["tracking_uri"] or default_tracking_uri(logger["root"]), logger["experiment_name"]

    def base(self, values: Settings) -> Path:
        """The base config of a trial."""
        return self.bases[values.get(BASE, next(iter(self.bases)))]

    def changes(self, values: Settings) -> Config:
        """The settings of a trial on top of its base config: the sweep's and its own."""
        return {**self.settings, **{key: value for key, value in values.items() if key != BASE}}

    def arguments(self, values: Settings) -> list[str]:
        """The command line of a trial, without its verb: base config, settings, and the trial's values."""
        return ["--config", str(self.base(values)), *write_options(self.changes(values))]

    def config(self, values: Settings) -> Config:
        """The base config with settings and values put in, as a config file has it."""
        config = read_yaml(self.base(values), "base config")
        full = ParsedConfig(self.arguments(values)).config.as_dict()
        for key, value in self.changes(values).items():
            change_value(config, full, key.split("."), value)
        return config

    def describe(self) -> dict[str, str]:
        """What must not change between two commands of a study, as JSON by its name in messages."""
        configs = {name: read_yaml(file, "base config") for name, file in self.bases.items()}
        fixed = {"configs": configs, "settings": dict(self.settings), "measure": self.measure}
        return {
            "search space": json.dumps({p.key: p.describe() for p in self.space}, sort_keys=True),
            "objectives": json.dumps([[o.metric, o.maximize] for o in self.objectives]),
            "base config or settings": json.dumps(fixed, sort_keys=True, default=str),
        }


def read_plan(file: Path, overrides: Settings) -> Plan:
    """Read a sweep file and check every part of it.

    Args:
        file: YAML.
        overrides: settings of the command line, which replace the file's: one that is searched is fixed instead, and
            `space.KEY` replaces the values that are searched.

    Raises:
        ConfigError: the file or a base config is missing or malformed, a key is unknown, or a value is refused.
    """
    raw = read_yaml(file, "sweep file")
    for field in raw:
        if field not in FIELDS:
            raise ConfigError(f"{file} has an unknown entry {field!r}; {suggest_name(str(field), FIELDS)}")
    bases = _find_bases(file, raw.get("base"))
    measure = raw.get("measure")
    if not isinstance(measure, str | None) or measure not in MEASURES:
        raise ConfigError(f"measure is {measure!r}; give test or features, or leave it out")
    settings = _parse_settings(raw.get("settings"))
    space = _narrow_space(raw.get("space"), bases, overrides)
    searched = {parameter.key for parameter in space}
    settings |= {k: value for k, value in overrides.items() if not k.startswith("space.") and k not in searched}
    settings, configs, space = check_settings(bases, settings, space)
    resolved = configs[0]
    alike = len({json.dumps(config["model"]["init_args"].get("loss"), default=str) for config in configs}) == 1
    usual = FEATURES[0] if measure == "features" else "val/loss" if alike else "val/position_median_m"
    plan = Plan(
        file=file,
        bases=bases,
        objectives=_parse_objectives(raw.get("objective", usual), measure),
        sampler=_parse_named(raw.get("sampler", "tpe"), "sampler"),
        pruner=_parse_named(raw.get("pruner", "none" if measure else "default"), "pruner"),
        n_trials=_check_whole(raw.get("n_trials"), "n_trials"),
        seed=_check_whole(raw.get("seed"), "seed") or 0,
        settings=settings,
        space=tuple(space),
        measure=measure,
        figure=raw.get("figure"),
        resolved=resolved,
    )
    weighed = [p.key for p in space if p.key.startswith("model.loss")] + [BASE] * (not alike)
    if weighed and any(objective.metric == "val/loss" for objective in plan.objectives):
        raise ConfigError(f"objective val/loss means something else for each {weighed[0]}; take val/position_median_m")
    for base, config in zip(bases.values(), configs, strict=True):
        logger = config["trainer"]["logger"]
        if not isinstance(logger, Mapping) or not str(logger.get("class_path")).endswith("MLflowLogger"):
            raise ConfigError(
                f"{base} has another trainer.logger, but a sweep keeps its trials in MLflow; leave it out"
            )
    return plan


def _parse_settings(raw: object) -> Config:
    if not isinstance(raw, Mapping | None):
        raise ConfigError(f"settings are {raw!r}; give them by name, as {{trainer.max_epochs: 10}}")
    return {normalize_key(key): value for key, value in (raw or {}).items()}


def _find_bases(file: Path, entry: object) -> dict[str, Path]:
    entries = entry if isinstance(entry, list) else [entry]
    if not entries or not all(isinstance(name, str) for name in entries):
        raise ConfigError(f"{file} names no base config; add a line such as `base: configs/surf_cnn.yaml`")
    found = [_find_base(file, str(name)) for name in entries]
    bases = {path.stem: path for path in found}
    if len(bases) < len(found):
        raise ConfigError(f"{file} names base configs of the same file name, {', '.join(map(str, found))}; rename one")
    return bases


def _find_base(file: Path, base: str) -> Path:
    for folder in (file.parent, Path(), Path(__file__).parents[2]):
        if (folder / base).is_file():
            return folder / base
    raise ConfigError(f"{file} names the base config {base}, which is not there; give its path from the sweep file")


def _narrow_space(raw: object, bases: Mapping[str, Path], overrides: Settings) -> list[Parameter]:
    """The search space, with the base config as its first parameter where there are several."""
    entries = {normalize_key(key): entry for key, entry in raw.items()} if isinstance(raw, dict) else {}
    if len(bases) > 1:
        entries = {BASE: list(bases), **entries}
    if entries:  # before it is narrowed: then a choice may be missing that a `when` names
        check_when(parse_space(entries))
    for key, value in overrides.items():
        name = key.removeprefix("space.")
        if name == key and key in entries:
            value = [value]
        elif name == key:
            continue
        before = entries.get(name)
        if isinstance(before, Mapping) and "when" in before and isinstance(value, list):
            value = {"choices": value, "when": before["when"]}
        entries[name] = value
    return parse_space(entries or raw)


def _parse_named(entry: object, what: str) -> Config:
    """`tpe` or `{name: tpe, n_startup_trials: 5}`."""
    named = {"name": entry} if isinstance(entry, str) else entry
    if not isinstance(named, dict) or not isinstance(named.get("name"), str):
        raise ConfigError(f"{what} is {entry!r}; give a name, or {{name: ..., option: ...}}")
    return named


def _check_whole(value: object, what: str) -> int | None:
    if value is not None and (not isinstance(value, int) or isinstance(value, bool) or value < 0):
        raise ConfigError(f"{what} is {value!r}; give a whole number, 0 or more")
    return value


def _parse_objectives(raw: object, measure: str | None) -> tuple[Objective, ...]:
    entries = raw if isinstance(raw, list) else [raw]
    if not entries:
        raise ConfigError("objective is empty; give val/loss, or leave it out")
    return tuple(
        _parse_objective(entry, FEATURES if measure == "features" else (*MEASURED, *COSTS)) for entry in entries
    )


def _parse_objective(entry: object, known: Sequence[str]) -> Objective:
    named = {"metric": entry} if isinstance(entry, str) else entry
    if not isinstance(named, dict) or not isinstance(named.get("metric"), str) or named.keys() - {"metric", "goal"}:
        raise ConfigError(f"objective is {entry!r}; give a metric, or {{metric: val/loss, goal: minimize}}")
    metric = named["metric"]
    if metric.startswith(("test/", "baseline/")):
        raise ConfigError(f"objective {metric} is measured on test frames, which must not choose; take its val/ name")
    if metric not in known:
        raise ConfigError(f"objective {metric} is not known; {suggest_name(metric, known)}")
    known_metric = catalog.find_metric(metric)
    goal = named.get("goal", "maximize" if known_metric and known_metric.higher_is_better else "minimize")
    if goal not in ("minimize", "maximize"):
        raise ConfigError(f"objective {metric} has goal {goal!r}; give minimize or maximize")
    return Objective(metric, goal == "maximize")
