"""The base config of a sweep: its settings by dotted name, and the config with some of them changed."""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml
from lightning.pytorch.utilities.seed import isolate_rng

from lightning_pose.cli import PoseCLI
from lightning_pose.data.datamodule import SceneDataModule
from lightning_pose.errors import ConfigError
from lightning_pose.features import LocalExtractor
from lightning_pose.sweeps.space import BASE, Config, Parameter, Settings, name_classes, suggest_name

__all__ = [
    "ParsedConfig",
    "change_value",
    "check_settings",
    "open_keypoint_data",
    "read_yaml",
    "resolve_config",
    "write_options",
]


class ParsedConfig(PoseCLI):
    """A command line that is parsed and checked, and then not run; no random number generator is seeded."""

    def __init__(self, args: list[str]) -> None:
        with isolate_rng(include_cuda=False):
            super().__init__(args, run=False)

    def instantiate_classes(self) -> None:
        """Overridden so that no class is built: only the config is wanted."""

    def change(self, base: Path, settings: Settings) -> Config:
        """The whole config of other settings of a base config, without the time that a new parser takes."""
        return self.parser.parse_args(["--config", str(base), *write_options(settings)]).as_dict()


def open_keypoint_data(config: ParsedConfig) -> tuple[SceneDataModule, LocalExtractor, list[Path]]:
    """Build a config's data module; its model and trainer are not built.

    Returns:
        The data module, its extractor, and the files of the training frames.

    Raises:
        ConfigError: the extractor finds no keypoints.
    """
    data = config.parser.instantiate_classes(config.config)["data"]
    assert isinstance(data, SceneDataModule)
    if not isinstance(data.extractor, LocalExtractor):
        raise ConfigError(f"{data.extractor.name} finds no keypoints; give an extractor that does, such as SURF")
    return data, data.extractor, [Path(data.scene.frames[i].image) for i in data.scene.splits["train"]]


def read_yaml(file: Path, what: str) -> Config:
    """The mapping in a YAML file.

    Raises:
        ConfigError: it cannot be read, or is no mapping; the message calls the file `what`.
    """
    try:
        content = yaml.safe_load(file.read_text())
    except OSError as error:
        raise ConfigError(f"the {what} {file} cannot be read ({error.strerror}); check the path") from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"the {what} {file} is not YAML ({' '.join(str(error).split())}); correct it") from error
    if not isinstance(content, dict):
        raise ConfigError(f"the {what} {file} is no mapping; see sweeps/surf_cnn.yaml")
    return content


def resolve_config(base: Path, settings: Settings) -> tuple[ParsedConfig, Config, Config]:
    """Put settings into a base config.

    Returns:
        A parser, the settings with a class by the name of its `class_path`, and the whole config, defaults included.

    Raises:
        ConfigError: a setting is unknown, or a value is refused.
    """
    cli = ParsedConfig(["--config", str(base)])
    known = list_settings(cli.config.as_dict())
    named = {
        f"{key}.class_path" if isinstance(value, str) and f"{key}.class_path" in known else key: value
        for key, value in settings.items()
    }
    classes = {key: value for key, value in named.items() if key.endswith(".class_path")}
    if classes:  # they have settings of their own
        known |= list_settings(cli.change(base, classes))
    for key in settings:
        _check_known(key, known, "")
    return cli, named, cli.change(base, named)


def check_settings(
    bases: Mapping[str, Path], settings: Settings, space: Sequence[Parameter]
) -> tuple[Config, list[Config], list[Parameter]]:
    """Check that every key is in its base config, or under a class that is searched, with values of the right type.

    Returns:
        The settings and the space, a class by the name of its `class_path`, and each base's whole config.

    Raises:
        ConfigError: a setting is unknown, or a value is refused.
    """
    found = {name: resolve_config(file, settings) for name, file in bases.items()}
    space = name_classes(space, set[str]().union(*(list_settings(resolved) for _, _, resolved in found.values())))
    for name, (cli, named, resolved) in found.items():
        own = [p for p in space if p.key != BASE and name in p.when.get(BASE, (name,))]
        known = list_settings(cli.config.as_dict()) | list_settings(resolved)
        classes = [parameter for parameter in own if parameter.key.endswith(".class_path")]
        for parameter in classes:
            for choice in parameter.example():
                known |= list_settings(cli.change(bases[name], {**named, parameter.key: choice}))
        for parameter in own:
            _check_known(parameter.key, known, "space.")
            if classes or set(parameter.when) - {BASE}:
                continue  # it may suit some trials only; each of them checks it
            for value in parameter.example():
                try:
                    cli.change(bases[name], {**named, parameter.key: value})
                except ConfigError as error:
                    raise ConfigError(f"space.{parameter.key} cannot be {value!r}: {error}") from error
    return next(iter(found.values()))[1], [resolved for _, _, resolved in found.values()], space


def _check_known(key: str, known: Settings, where: str) -> None:
    """Refuse a setting that a config does not have.

    Raises:
        ConfigError: it has no setting of this name; the message names the nearest.
    """
    parts = key.split(".")
    above = [".".join(parts[:n]) for n in range(2, len(parts))]
    # The parser checks what is below a setting that is null by default.
    if key not in known and not any(name in known and known[name] is None for name in above):
        raise ConfigError(f"{where}{key} is no setting of the base config; {suggest_name(key, list(known))}")


def list_settings(config: Settings, prefix: str = "") -> Config:
    """Every setting by its dotted name without `init_args`, and every group of settings."""
    found: Config = {}
    for name, value in config.items():
        key = prefix if name == "init_args" else f"{prefix}.{name}" if prefix else str(name)
        if isinstance(value, Mapping):
            found |= {key: value} if name != "init_args" else {}
            found |= list_settings(value, key)
        else:
            found[key] = value
    return found


def write_options(values: Settings) -> list[str]:
    """Settings as words of a command line, classes first: a class drops the arguments that it does not have."""
    ordered = sorted(values.items(), key=lambda item: not item[0].endswith(".class_path"))
    return [
        f"--{key.removesuffix('.class_path')}={value if isinstance(value, str) else json.dumps(value)}"
        for key, value in ordered
    ]


def change_value(config: Config, full: Settings, parts: Sequence[str], value: object) -> None:
    """Set one value in a config file's content, in `init_args` wherever the whole config `full` has them."""
    head, *rest = parts
    if "init_args" in full and head != "class_path":
        config.setdefault("class_path", full["class_path"])
        config = config.setdefault("init_args", {})
        full = full["init_args"]
    if not rest:
        if head == "class_path" and "init_args" in config:
            config["init_args"] = {k: v for k, v in config["init_args"].items() if k in full.get("init_args", {})}
        # `--data.root 2024` is a folder, not a number.
        config[head] = full[head] if isinstance(full.get(head), str) else copy.deepcopy(value)
        return
    if not isinstance(config.get(head), dict):
        config[head] = {}
    change_value(config[head], full.get(head) or {}, rest, value)
