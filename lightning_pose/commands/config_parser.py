"""The parser of LightningCLI's verbs: older class paths are renamed, mistakes become one line, help has examples."""

from __future__ import annotations

import argparse
from typing import Any, NoReturn

import yaml
from jsonargparse import DefaultHelpFormatter, get_loader, set_loader
from lightning.pytorch.cli import LightningArgumentParser

from lightning_pose.checkpoint import resolve_class_path, resolve_class_paths
from lightning_pose.commands.setting_errors import explain_setting_error
from lightning_pose.errors import ConfigError

__all__ = ["ALLOW_HELP", "PoseParser", "parser_settings", "rename_value"]


class _HelpFormatter(argparse.RawDescriptionHelpFormatter, DefaultHelpFormatter):
    """Keeps the examples as they are written."""


PARSER_MODE = "yaml_with_renames"


def load_with_renames(text: str) -> object:
    """A YAML value in which classes have today's paths: a config's whole content, or one value of a command line."""
    return resolve_class_paths(get_loader("yaml")(text))


set_loader(PARSER_MODE, load_with_renames, exceptions=(yaml.YAMLError,))


def rename_value(word: str) -> str:
    """A word of the command line, `VALUE` or `--NAME=VALUE`, an older class path in it replaced by today's."""
    name, equals, value = word.rpartition("=")
    return f"{name}{equals}{resolve_class_path(value)}"


class PoseParser(LightningArgumentParser):
    """A parser that replaces older class paths by today's, and raises ConfigError for a wrong setting.

    So a wrong setting ends in one line, as every mistake of a user does.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        # jsonargparse makes parsers of this class for nested settings too, with the mode of the outer parser.
        settings: dict[str, Any] = {"formatter_class": _HelpFormatter, **kwargs, "parser_mode": PARSER_MODE}
        super().__init__(*args, **settings)

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        raise ConfigError(explain_setting_error(message)) from ex


HELP = {
    "fit": """Train a localizer, test its best checkpoint, and print it beside its baselines.

  the built-in room      fit --config configs/quickstart.yaml
  your data              fit --config configs/landmark_map.yaml --data.root DIR
  video, unseen scenes   fit --config configs/cnn_rnn.yaml --data.train_scenes "[DIR]" --data.test_scenes "[DIR]"
  change any setting     ... --model.units 200 --data.extractor.n_features 100 --trainer.max_epochs 20
  another seed           ... --seed_everything 1
  go on after a stop     ... --ckpt_path last, with the same settings; --trainer.max_epochs may be raised
  see every run          mlflow ui --backend-store-uri sqlite:///mlruns/mlflow.db

Settings of an architecture, a data module, a feature extractor:

  fit --model.help lightning_pose.models.SurfLSTM
  fit --data.help lightning_pose.data.ImageDataModule
  fit --data lightning_pose.data.ImageDataModule --data.extractor.help lightning_pose.features.SURF""",
    "validate": """Measure a checkpoint on the validation frames that it has not learnt from.
The checkpoint knows its architecture and its data.

  validate --ckpt_path mlruns/checkpoints/RUN_ID/best.ckpt""",
    "test": """Measure a checkpoint on the test frames, beside its baselines, in a run of its own.
The checkpoint knows its architecture and its data; both can be overridden.

  test --ckpt_path mlruns/checkpoints/RUN_ID/best.ckpt
  test --ckpt_path mlruns/checkpoints/RUN_ID/best.ckpt --data.root OTHER_COPY
  test --ckpt_path FILE --allow my_package.MyNet      a checkpoint that names a class of your own""",
    "predict": """Write a checkpoint's poses of the test frames, one TUM file a sequence.

  predict --ckpt_path mlruns/checkpoints/RUN_ID/best.ckpt""",
    "extract": """Fill the feature cache that a config needs, on all cores; what is cached already is kept.

  extract --config configs/surf_lstm.yaml --data.root DIR
  on many machines       ... --scheduler tcp://HOST:8786""",
}


ALLOW_HELP = """Class path, or package, of your own architecture, extractor or backbone that the checkpoint may name.
May be given several times. Classes of this package, and those that your config or command line names, are allowed."""

PROGRAM = "python -m lightning_pose"


def parser_settings(verb: str) -> dict[str, str]:
    return {
        "prog": f"{PROGRAM} {verb}",
        "usage": f"{PROGRAM} {verb} --config FILE [--SETTING VALUE ...]",
        "description": HELP[verb],
    }
