"""The localizer as an MLflow model: a table of images in, a table of poses out.

MLflow runs this file when it loads the model, which is safer than a pickle. The last line registers the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from mlflow.exceptions import MlflowException
from mlflow.models import set_model
from mlflow.protos.databricks_pb2 import INVALID_PARAMETER_VALUE
from mlflow.pyfunc.model import PythonModel, PythonModelContext

from lightning_pose.errors import ConfigError, PoseError
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import LocatedPose
from lightning_pose.localization.mlflow_signature import SIGNATURE
from lightning_pose.localization.picture_head import MAX_PIXELS, check_head
from lightning_pose.localization.prior_text import parse_prior

__all__ = ["LocalizerModel"]


class LocalizerModel(PythonModel):
    """The model that `mlflow.pyfunc.load_model` loads from a run's `model`."""

    def load_context(self, context: PythonModelContext) -> None:
        # `fit` says here which classes of the user's own it trained; the checkpoint itself is not believed.
        settings = context.model_config or {}
        self.localizer = Localizer.load(context.artifacts["checkpoint"], settings.get("allow", ()))
        self.max_pixels = int(settings.get("max_pixels", MAX_PIXELS))

    def predict(
        self, context: PythonModelContext | None, model_input: pd.DataFrame, params: dict[str, Any] | None = None
    ) -> pd.DataFrame:
        """Locate images.

        Args:
            context: not used; MLflow passes it.
            model_input: as `SIGNATURE` has it. For a model of clips the rows are one video, in order.
            params: not used.

        Returns:
            One row an image: camera centre in metres, camera-to-world quaternion, and how sure it is.

        Raises:
            MlflowException: a row cannot be used; a server answers it with status 400.
        """
        rows = model_input.to_dict("records")
        try:
            images = [self._check_image(row, i) for i, row in enumerate(rows)]
            if self.localizer.system.clips is not None:
                poses = self.localizer.localize(images)
            else:
                poses = [self._locate(image, row, i) for i, (image, row) in enumerate(zip(images, rows, strict=True))]
        except PoseError as error:
            raise MlflowException(str(error), INVALID_PARAMETER_VALUE) from error
        return pd.DataFrame([_list_values(pose) for pose in poses], columns=pd.Index(SIGNATURE.outputs.input_names()))

    def _check_image(self, row: Mapping[Any, object], number: int) -> bytes:
        image = row["image"]
        if not isinstance(image, bytes):
            raise ConfigError(f"row {number}: image is of type {type(image).__name__}; give the bytes of an image file")
        try:
            check_head(image, self.max_pixels)
        except PoseError as error:
            raise type(error)(f"row {number}: {error}") from error
        return image

    def _locate(self, image: bytes, row: Mapping[Any, object], number: int) -> LocatedPose:
        camera, prior = (value if isinstance(value := row.get(name), str) else None for name in ("camera", "prior"))
        try:
            return self.localizer.localize(image, camera, parse_prior(prior))
        except PoseError as error:
            raise type(error)(f"row {number}: {error}") from error


def _list_values(pose: LocatedPose) -> list[object]:
    """A row of the answer: numbers that are not finite are None, as JSON has no others."""
    radii = [float(radius) if np.isfinite(radius) else None for radius in (pose.radius_m, pose.radius_deg)]
    known = [pose.inliers, pose.visible, pose.status, pose.reason, pose.source]
    return [*map(float, pose.position_m), *map(float, pose.quat_wxyz), *radii, *known]


set_model(LocalizerModel())
