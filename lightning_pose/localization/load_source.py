"""Where a localizer comes from: a checkpoint, a run, a registered model, or an exported folder."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from lightning_pose.errors import CheckpointError, ConfigError
from lightning_pose.paths import STORE_VARIABLE

if TYPE_CHECKING:
    from lightning_pose.localization.localizer import LocatingSystem

__all__ = ["find_checkpoint", "load_system"]

EXPORTED_FILE = "localizer.json"
"""The file by which a folder that `export` wrote is known."""


def load_system(source: str | Path, allow: Sequence[str] = (), tracking_uri: str | None = None) -> LocatingSystem:
    """Load what `Localizer.load` is given.

    Raises:
        CheckpointError: it cannot be read, or names a class that is not allowed.
        ConfigError: it is none of these, or MLflow does not have it.
    """
    folder = Path(source).expanduser()
    if folder.is_dir():
        if not (folder / EXPORTED_FILE).is_file():
            raise ConfigError(
                f"{source} is a folder without {EXPORTED_FILE}, so that `export` did not write it; give a checkpoint "
                "such as mlruns/checkpoints/RUN_ID/best.ckpt"
            )
        return _load_exported(folder)
    checkpoint = find_checkpoint(source, tracking_uri)
    from lightning_pose.localization.trained_system import TrainedSystem  # torch, which takes seconds to import

    return TrainedSystem.from_checkpoint(checkpoint, allow)


def _load_exported(folder: Path) -> LocatingSystem:
    """The system of a folder that `export` wrote, without torch; code in the folder is not run."""
    from lightning_pose.export.runner.system import ExportedSystem

    return ExportedSystem(folder)


def find_checkpoint(source: str | Path, tracking_uri: str | None = None) -> Path:
    """The checkpoint file of a path, an MLflow run id, or a model's address.

    Args:
        source: a file; 32 hexadecimal digits; `runs:/RUN_ID/model`, `models:/NAME@ALIAS` or `models:/NAME/VERSION`.
        tracking_uri: MLflow's store; by default `MLFLOW_TRACKING_URI`, or else `sqlite:///mlruns/mlflow.db`.

    Raises:
        CheckpointError: the file does not exist.
        ConfigError: MLflow does not have the run or the model, or the run logged no model.
    """
    text = str(source)
    path = Path(source).expanduser()
    if path.is_file():
        return path
    if re.fullmatch(r"[0-9a-f]{32}", text):
        return _find_local_checkpoint(text, tracking_uri) or _download_checkpoint(f"runs:/{text}/model", tracking_uri)
    if text.startswith(("runs:/", "models:/")):
        return _download_checkpoint(text, tracking_uri)
    raise CheckpointError(
        f"{source} does not exist; give a checkpoint such as mlruns/checkpoints/RUN_ID/best.ckpt, a run id, "
        "models:/NAME@ALIAS, or a folder that `export` wrote"
    )


def _find_local_checkpoint(run_id: str, tracking_uri: str | None) -> Path | None:
    """The best checkpoint of a run that was trained here, beside its store; None if it is not there."""
    from lightning_pose.paths import default_tracking_uri
    from lightning_pose.runs.store import sqlite_file

    file = sqlite_file(tracking_uri or default_tracking_uri())
    found = None if file is None else file.parent / "checkpoints" / run_id / "best.ckpt"
    return found if found is not None and found.is_file() else None


def _download_checkpoint(address: str, tracking_uri: str | None) -> Path:
    """The checkpoint inside a model that MLflow keeps; none of the model's own code is run."""
    from mlflow.artifacts import download_artifacts  # seconds
    from mlflow.exceptions import MlflowException

    from lightning_pose.runs.reader import mask_passwords
    from lightning_pose.runs.store import prepare_store

    store = prepare_store(tracking_uri)
    try:
        place = _find_registered(address, store)
        with _use_store(store):
            folder = Path(download_artifacts(place, tracking_uri=store, registry_uri=store))
    except (MlflowException, OSError) as error:
        reason = mask_passwords(" ".join(str(error).split()))[:200]
        raise ConfigError(
            f"{mask_passwords(store)} has no model {address} ({reason}); check the name and MLFLOW_TRACKING_URI, and "
            "that the run logged a model (report.log_model)"
        ) from error
    checkpoints = sorted(folder.rglob("*.ckpt"))
    if len(checkpoints) != 1:
        raise ConfigError(f"{address} has {len(checkpoints)} checkpoints where a model that `fit` logged has one")
    return checkpoints[0]


@contextmanager
def _use_store(store: str) -> Iterator[None]:
    """Let MLflow use this store; it looks a logged model up in the process's own, whichever is given."""
    import mlflow

    variable, process_uri = os.environ.get(STORE_VARIABLE), mlflow.get_tracking_uri()
    mlflow.set_tracking_uri(store)
    try:
        yield
    finally:
        mlflow.set_tracking_uri(process_uri)
        os.environ.pop(STORE_VARIABLE, None)  # `set_tracking_uri` sets it
        if variable is not None:
            os.environ[STORE_VARIABLE] = variable


def _find_registered(address: str, store: str) -> str:
    """Where a registered model is kept; other addresses as they are.

    MLflow looks for the name in the store of the process, whatever store it is given.
    """
    from mlflow import MlflowClient

    named = re.fullmatch(r"models:/([^/@]+)(?:@(.+)|/(\d+))", address)
    if named is None:
        return address
    client = MlflowClient(tracking_uri=store, registry_uri=store)
    name, alias, version = named.groups()
    number = client.get_model_version_by_alias(name, alias).version if alias else version
    return client.get_model_version_download_uri(name, str(number))
