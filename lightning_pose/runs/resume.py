"""Which checkpoints training can go on from, and with which settings."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning_pose.checkpoint import Spec, read_checkpoint
from lightning_pose.errors import CheckpointError, ConfigError
from lightning_pose.runs.client import BufferedClient
from lightning_pose.runs.logger import flatten_settings
from lightning_pose.runs.tags import OPERATIONAL

__all__ = ["PLACES", "check_architecture", "check_resumable", "check_same_settings", "is_complete", "read_seed"]

PLACES = ("root", "train_scenes", "test_scenes", "val_scenes", "pgt", "format")
"""Settings of the data that say where it is; a dataset may have moved since the run began."""


def read_seed() -> int | None:
    """The seed that Lightning has set for this process."""
    seed = os.environ.get("PL_GLOBAL_SEED")
    return int(seed) if seed else None


def check_architecture(checkpoint: str, saved: str, asked: str | None) -> None:
    """Refuse a config whose architecture is not the checkpoint's, before the two are mixed."""
    if asked is not None and asked.rpartition(".")[2] != saved.rpartition(".")[2]:
        raise CheckpointError(
            f"{checkpoint} holds a {saved.rpartition('.')[2]}, but the config asks for {asked.rpartition('.')[2]}; "
            "give the config it was trained with"
        )


def check_resumable(checkpoint: str, architecture: str, max_epochs: int | None, finishing: bool) -> None:
    """Refuse a checkpoint that training cannot go on from, before a run is opened for it.

    Args:
        checkpoint: the file.
        architecture: class path of the config's model.
        max_epochs: of the config.
        finishing: the run is to be finished, so that it may have no epoch to train and only its test to do.

    Raises:
        CheckpointError: it holds another architecture, weights alone, or all epochs that were asked for.
    """
    saved = read_checkpoint(checkpoint)
    check_architecture(checkpoint, saved["lightning_pose"]["model"]["class_path"], architecture)
    if "optimizer_states" not in saved:
        raise CheckpointError(f"{checkpoint} holds weights only, which can be tested; give the last.ckpt beside it")
    epochs = saved["epoch"] + 1
    if not finishing and max_epochs is not None and 0 <= max_epochs <= epochs:
        raise CheckpointError(
            f"{checkpoint} has {epochs} epochs behind it and trainer.max_epochs is {max_epochs}; "
            "raise --trainer.max_epochs"
        )


def check_same_settings(checkpoint: str, model: Spec, data: Spec, seed: int | None, precision: object) -> None:
    """Refuse settings other than those that a run began with.

    The optimizer's state, the scales and the random state come from the checkpoint, and a run's parameters in MLflow
    cannot be changed: another setting would have no effect, or would not be recorded.

    Args:
        checkpoint: the file.
        model: spec of the model that the config describes.
        data: spec of its data.
        seed: of this process.
        precision: of the trainer.

    Raises:
        ConfigError: a setting differs; the message has both values.
    """
    saved = read_checkpoint(checkpoint)
    specs = saved["lightning_pose"]
    began = {**_name_settings(specs["model"], specs["data"]), **_read_trainer_settings(saved)}
    asked = {**_name_settings(model, data), "seed_everything": seed, "trainer.precision": str(precision)}
    changed = [name for name in began if name in asked and began[name] != asked[name]]
    if changed:
        shown = ", ".join(f"{name} is {asked[name]} and was {began[name]}" for name in sorted(changed))
        raise ConfigError(
            f"{shown}, but a run goes on with the settings that it began with; give those, or leave --ckpt_path out "
            "to start a new run"
        )


def is_complete(uri: str, run_id: str) -> bool:
    """Whether an MLflow run has ended with the results of its test."""
    run = BufferedClient(uri).get_run(run_id)
    return run.info.status == "FINISHED" and any(name.startswith("test/") for name in run.data.metrics)


def _name_settings(model: Spec, data: Spec | None) -> dict[str, object]:
    """The settings of a model and its data by the names of the command line, without places and operation."""
    named = flatten_settings({"model": model["init_args"], "data": data["init_args"] if data else {}})
    left_out = {f"data.{name}" for name in (*PLACES, *OPERATIONAL)} | {"model.input_shape"}
    return {name: _to_plain(value) for name, value in named.items() if name not in left_out}


def _to_plain(value: object) -> object:
    """Tuples as lists, and whole numbers as floats, as files and command lines may have either."""
    if isinstance(value, list | tuple):
        return [_to_plain(item) for item in value]
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return str(value) if isinstance(value, Path) else value


def _read_trainer_settings(checkpoint: Mapping[str, Any]) -> dict[str, object]:
    """The seed and precision that a checkpoint was trained with; nothing for one of an older version."""
    states = (state for name, state in checkpoint.get("callbacks", {}).items() if name.startswith("LastCheckpoint"))
    return next(states, {}).get("settings", {})
