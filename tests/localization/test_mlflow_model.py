"""The model that MLflow keeps: images in, a table of poses out, the same numbers as the localizer's."""

from __future__ import annotations

import shutil
from pathlib import Path

import mlflow
import numpy as np
import pandas as pd
import pytest
from mlflow.pyfunc import PyFuncModel  # type: ignore[attr-defined]

from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import stack_poses
from tests.helpers import REPOSITORY, Trained

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
    position_m, quat_wxyz = stack_poses(Localizer.load(trained.best, allow="tests").localize(images))
    np.testing.assert_allclose(poses.to_numpy(), np.hstack([position_m, quat_wxyz]))


def test_it_carries_this_package(model: PyFuncModel) -> None:
    assert model.metadata.flavors["python_function"]["code"] == "code"


def test_the_docs_load_it_in_a_copied_project(
    trained: Trained, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lines of docs/usage.md, in a folder for which MLflow has other places of artifacts."""
    run, image = trained.run.info.run_id, str(next((scene / "seq-03").glob("*.png")))
    shutil.copytree(trained.workplace.folder, tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    # MLflow keeps an open store by its address, and a relative one is that of another test's folder
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/copy/mlruns/mlflow.db")
    page = (REPOSITORY / "docs" / "usage.md").read_text()
    code = page.split("```python\n")[1].split("```")[0].replace("RUN_ID", run).replace("image.jpg", image)
    names: dict[str, pd.DataFrame] = {}
    exec(code, names)
    expected = np.hstack(stack_poses(Localizer.load(trained.best, allow="tests").localize([image])))
    np.testing.assert_allclose(names["poses"].to_numpy(), expected)
    place = mlflow.get_run(run).info.artifact_uri
    assert str(place).startswith((tmp_path / "copy" / "mlruns" / "artifacts").as_uri())
