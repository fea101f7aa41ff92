"""The model that MLflow keeps: images in, a table of poses out, the same numbers as the localizer's."""

from __future__ import annotations

from pathlib import Path

import mlflow
import numpy as np
import pandas as pd
import pytest
from mlflow.pyfunc import PyFuncModel  # type: ignore[attr-defined]

from lightning_pose.localization.localizer import Localizer
from tests.helpers import Trained

COLUMNS = ["x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"]


@pytest.fixture(scope="module")
def model(trained: Trained) -> PyFuncModel:
    mlflow.set_tracking_uri(trained.workplace.uri)
    return mlflow.pyfunc.load_model(f"runs:/{trained.run.info.run_id}/model")


@pytest.mark.parametrize("as_table", [True, False])
def test_a_row_for_each_image(as_table: bool, model: PyFuncModel, trained: Trained, scene: Path) -> None:
    images = [str(image) for image in sorted((scene / "seq-03").glob("*.png"))]
    poses = model.predict(pd.DataFrame({"image": images}) if as_table else images)
    assert list(poses.columns) == COLUMNS
    position_m, quat_wxyz = Localizer.from_checkpoint(trained.best, allow="tests")(images)
    np.testing.assert_allclose(poses.to_numpy(), np.hstack([position_m, quat_wxyz]))


def test_it_carries_this_package(model: PyFuncModel) -> None:
    assert model.metadata.flavors["python_function"]["code"] == "code"
