"""Finds the run that `--ckpt_path last` goes on with."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from lightning_pose.errors import CheckpointError
from lightning_pose.runs.client import BufferedClient
from lightning_pose.runs.reader import read_pages
from lightning_pose.runs.store import prepare_store

__all__ = ["find_last_run"]

PARAMETER_LENGTH = 250
"""Characters of a parameter that Lightning's logger keeps."""


def find_last_run(
    uri: str, experiment_name: str, checkpoints: Path, architecture: str, data: Mapping[str, object]
) -> tuple[str, Path]:
    """Find the newest run of an architecture on a scene that left a `last.ckpt`.

    Args:
        uri: MLflow store.
        experiment_name: MLflow experiment.
        checkpoints: folder of the runs' checkpoint folders.
        architecture: class name.
        data: which scenes it trains on: settings of the data module by name, such as `root`.

    Returns:
        The run's id and its last checkpoint.

    Raises:
        CheckpointError: there is no such run.
    """
    client = BufferedClient(prepare_store(uri))
    experiment = client.get_experiment_by_name(experiment_name)
    ids = [experiment.experiment_id] if experiment else []
    query = f"tags.architecture = '{architecture}'"
    # Newest first. The scenes are compared here, because MLflow's query has no way to write a quotation mark.
    runs = read_pages(lambda token: client.search_runs(ids, query, page_token=token)) if ids else ()
    for run in runs:
        checkpoint = checkpoints / run.info.run_id / "last.ckpt"
        # Older runs lack settings that are new since; None is their default.
        scenes = {name: run.data.params.get(f"data.{name}", "None") for name in data}
        if checkpoint.is_file() and all(_is_same_scene(scenes[name], value) for name, value in data.items()):
            return run.info.run_id, checkpoint
    scene = " ".join(f"data.{name}={value}" for name, value in data.items())
    raise CheckpointError(
        f"no run of {architecture} on {scene} left a last.ckpt under {checkpoints}; leave --ckpt_path out to start one"
    )


def _is_same_scene(logged: str | None, value: object) -> bool:
    """Whether a parameter of a run names the same folders as a setting does, however each of them is written."""
    if logged is None or logged == str(value)[:PARAMETER_LENGTH]:
        return logged is not None
    with suppress(ValueError, SyntaxError):
        return _list_folders(ast.literal_eval(logged) if isinstance(value, list) else logged) == _list_folders(value)
    return False


def _list_folders(value: object) -> list[Path]:
    """Absolute paths of one folder or of several, without symbolic links."""
    names = value if isinstance(value, list) else [value]
    return [Path(str(name)).expanduser().resolve() for name in names]
