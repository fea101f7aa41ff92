"""The localizer as an MLflow model: a table of image files in, a table of poses out.

MLflow runs this file when it loads the model, which is safer than a pickle. The last line registers the model.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from mlflow.models import set_model
from mlflow.pyfunc.model import PythonModel, PythonModelContext

from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import stack_poses

__all__ = ["LocalizerModel"]

COLUMNS = ["x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"]


class LocalizerModel(PythonModel):
    """The model that `mlflow.pyfunc.load_model` loads from a run's `model`."""

    def load_context(self, context: PythonModelContext) -> None:
        # `fit` says here which classes of the user's own it trained; the checkpoint itself is not believed.
        allow = (context.model_config or {}).get("allow", ())
        self.localizer = Localizer.load(context.artifacts["checkpoint"], allow)

    def predict(
        self, context: PythonModelContext | None, model_input: list[str], params: dict[str, Any] | None = None
    ) -> pd.DataFrame:
        """Locate images.

        Args:
            context: not used; MLflow passes it.
            model_input: image files; MLflow makes this list of a table with one column, too.
            params: not used.

        Returns:
            One row an image: camera centre in metres and camera-to-world quaternion.
        """
        return pd.DataFrame(
            np.hstack(stack_poses(self.localizer.localize(list(model_input)))), columns=pd.Index(COLUMNS)
        )


set_model(LocalizerModel())
