"""The model that MLflow keeps: images in, a table of poses out; loaded, registered, and served by MLflow itself."""

from __future__ import annotations

import base64
import json
import shutil
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mlflow
import numpy as np
import pandas as pd
import pytest
import uvicorn
from mlflow.exceptions import MlflowException
from mlflow.models import Model
from mlflow.pyfunc import PyFuncModel, scoring_server  # type: ignore[attr-defined]

from lightning_pose.errors import ConfigError
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import stack_poses
from tests.helpers import REPOSITORY, Trained
from tests.serving.helpers import Answer, Server, encode_picture, make_png

POSE = ["x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"]


@pytest.fixture(scope="module")
def model(trained: Trained) -> PyFuncModel:
    mlflow.set_tracking_uri(trained.workplace.uri)
    return mlflow.pyfunc.load_model(f"runs:/{trained.run.info.run_id}/model")


@pytest.fixture
def images(scene: Path) -> list[Path]:
    return sorted((scene / "seq-03").glob("*.png"))


def make_table(images: list[Path]) -> pd.DataFrame:
    return pd.DataFrame({"image": [image.read_bytes() for image in images]})


def test_a_row_for_each_image(model: PyFuncModel, trained: Trained, images: list[Path]) -> None:
    poses = model.predict(make_table(images))
    expected = stack_poses(Localizer.load(trained.best, allow="tests").localize(images))
    np.testing.assert_allclose(poses[POSE].to_numpy(), np.hstack(expected))
    assert set(poses["status"]) == {"accepted"}
    assert set(poses["source"]) == {"network"}


def test_the_model_says_what_it_takes_and_carries_this_package(model: PyFuncModel, trained: Trained) -> None:
    assert model.metadata.flavors["python_function"]["code"] == "code"
    schema = model.metadata.get_input_schema()
    assert schema is not None
    assert [(spec.name, spec.type.name, spec.required) for spec in schema.inputs] == [
        ("image", "binary", True),
        ("camera", "string", False),
        ("prior", "string", False),
    ]
    example = Model.load(f"runs:/{trained.run.info.run_id}/model").load_input_example()
    assert len(model.predict(example)) == 1


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"image": [b"no image"]}, "row 0: the bytes are no image"),
        ({"image": [encode_picture(), make_png(60_000, 60_000, b"")]}, "row 1: the image has more than 25,000,000"),
        ({"image": [encode_picture()], "prior": ["1,2"]}, "row 0: prior is '1,2'; give x,y,z,qw,qx,qy,qz"),
        ({"image": [encode_picture()], "camera": ["PINHOLE,1"]}, "row 0: .*camera"),
        ({"image": ["/etc/hostname"]}, "row 0: image is of type str; give the bytes of an image file"),
        ({"path": ["/etc/hostname"]}, "missing inputs"),
    ],
)
def test_what_cannot_be_used_names_its_row(model: PyFuncModel, table: dict[str, list[Any]], message: str) -> None:
    with pytest.raises(MlflowException, match=message) as caught:
        model.predict(pd.DataFrame(table))
    assert caught.value.get_http_status_code() == 400


def test_the_docs_load_it_in_a_copied_project(
    trained: Trained, images: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lines of docs/tracking.md, in a folder for which MLflow has other places of artifacts."""
    run = trained.run.info.run_id
    shutil.copytree(trained.workplace.folder, tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    # MLflow keeps an open store by its address, and a relative one is that of another test's folder
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/copy/mlruns/mlflow.db")
    page = (REPOSITORY / "docs" / "tracking.md").read_text()
    code = page.split("```python\n")[1].split("```")[0].replace("RUN_ID", run).replace("image.jpg", str(images[0]))
    names: dict[str, pd.DataFrame] = {}
    exec(code, names)
    expected = np.hstack(stack_poses([Localizer.load(trained.best, allow="tests").localize(images[0])]))
    np.testing.assert_allclose(names["poses"][POSE].to_numpy(), expected)
    place = mlflow.get_run(run).info.artifact_uri
    assert str(place).startswith((tmp_path / "copy" / "mlruns" / "artifacts").as_uri())


def test_a_registered_model_has_an_alias(trained: Trained, images: list[Path], tmp_path: Path) -> None:
    """In a copy of the store, because the run is shared; its artifacts stay where they are."""
    shutil.copy(trained.workplace.folder / "mlruns" / "mlflow.db", tmp_path / "mlflow.db")
    uri = f"sqlite:///{tmp_path}/mlflow.db"
    mlflow.set_tracking_uri(uri)
    version = mlflow.register_model(f"runs:/{trained.run.info.run_id}/model", "wall").version
    mlflow.MlflowClient().set_registered_model_alias("wall", "champion", version)
    poses = mlflow.pyfunc.load_model("models:/wall@champion").predict(make_table(images[:1]))
    mlflow.set_tracking_uri(trained.workplace.uri)  # which does not have the name
    expected = Localizer.load("models:/wall@champion", allow="tests", tracking_uri=uri).localize(images[0])
    np.testing.assert_allclose(poses[POSE[:3]].to_numpy()[0], expected.position_m)
    by_number = Localizer.load(f"models:/wall/{version}", allow="tests", tracking_uri=uri).localize(images[0])
    np.testing.assert_array_equal(by_number.position_m, expected.position_m)
    for address in ("models:/wall@nobody", "models:/wall/7", "models:/floor/1", "models:/wall"):
        with pytest.raises(ConfigError, match=f"has no model {address} "):
            Localizer.load(address, tracking_uri=uri)


@pytest.fixture(scope="module")
def server(model: PyFuncModel) -> Iterator[Server]:
    """What `mlflow models serve` runs, in this process."""
    config = uvicorn.Config(scoring_server.init(model), port=0, log_level="critical")
    running = uvicorn.Server(config)
    thread = threading.Thread(target=running.run)
    thread.start()
    while not running.started:
        time.sleep(0.01)
    yield Server(running.servers[0].sockets[0].getsockname()[1])
    running.should_exit = True
    thread.join()


def invoke(server: Server, content: object) -> Answer:
    return server.ask("POST", "/invocations", json.dumps(content).encode(), {"Content-Type": "application/json"})


def make_records(image: bytes) -> dict[str, list[dict[str, str]]]:
    return {"dataframe_records": [{"image": base64.b64encode(image).decode()}]}


def test_mlflow_serves_it_to_fifty_at_once(server: Server, model: PyFuncModel, images: list[Path]) -> None:
    expected = model.predict(make_table(images[:1])).to_dict("records")
    content = make_records(images[0].read_bytes())
    with ThreadPoolExecutor(50) as threads:
        answers = list(threads.map(lambda _: invoke(server, content), range(50)))
    assert [answer.status for answer in answers] == [200] * 50
    for answer in answers:
        (pose,) = answer.json["predictions"]
        assert pose == pytest.approx(expected[0], nan_ok=True)
        assert pose["radius_m"] is None  # and not NaN, which is no JSON


@pytest.mark.parametrize(
    "content",
    [
        [],
        {},
        {"dataframe_records": [{}]},
        {"dataframe_records": [{"image": 5}]},
        {"dataframe_records": [{"image": "/etc/hostname"}]},
        {"dataframe_records": [{"path": "/etc/hostname"}]},
        {"inputs": ["/etc/hostname"]},
        make_records(b"no image"),
        make_records(make_png(60_000, 60_000, bytes(1_000_000))),
    ],
    ids=["list", "empty", "no image", "number", "file", "path", "inputs", "not an image", "bomb"],
)
def test_mlflow_refuses_malformed_requests(server: Server, content: object) -> None:
    answer = invoke(server, content)
    assert answer.status == 400, answer.body
    assert Path("/etc/hostname").read_bytes().strip() not in answer.body
