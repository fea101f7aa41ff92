"""Every config file: it parses, describes what it says, and trains end to end on a tiny rendered room."""

from __future__ import annotations

from pathlib import Path

import mlflow
import numpy as np
import pandas as pd
import pytest
import yaml

from lightning_pose.cli import PoseCLI
from lightning_pose.features import LocalExtractor
from lightning_pose.metrics.catalog import BASELINES, COSTS, ERRORS
from lightning_pose.models import PoseModule
from lightning_pose.scenes.synthetic import render_room
from tests.helpers import REPOSITORY, Workplace

CONFIGS = sorted((REPOSITORY / "configs").rglob("*.yaml"))
FIGURES = {
    "ImageDataModule": {"trajectory.png", "cumulative_errors.png", "error_vs_distance.png"},
    "ClipDataModule": {"trajectory.png", "error_by_length.png"},
}
MAP_FIGURES = {"map.png", "error_vs_inliers.png", "matched_images.png"}
every_config = pytest.mark.parametrize("config", CONFIGS, ids=lambda path: f"{path.parent.name}-{path.stem}")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_room(tmp_path_factory.mktemp("rooms") / "small", frames=30, size=(96, 72))


def test_there_are_configs() -> None:
    assert {"quickstart", "surf_cnn", "surf_lstm"} <= {path.stem for path in CONFIGS}


@every_config
def test_it_describes_a_model_for_its_features(config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    cli = PoseCLI(["--config", str(config), "--trainer.logger", "false"], run=False)
    assert isinstance(cli.model, PoseModule)
    assert cli.model.input_shape == cli.datamodule.input_shape
    assert config.read_text().startswith("# "), "a config says what it trains"


@every_config
def test_it_trains_tests_and_keeps_its_results(
    config: Path, room: Path, workplace: Workplace, capsys: pytest.CaptureFixture[str]
) -> None:
    small = ["--trainer.max_epochs", "1", "--trainer.accelerator", "cpu"]
    data = yaml.safe_load(config.read_text())["data"]
    kind, extractor = data["class_path"].rpartition(".")[2], data["init_args"]["extractor"]
    if kind == "ClipDataModule":
        small += ["--data.clip_length", "4"]
    if issubclass(_class_of(extractor["class_path"]), LocalExtractor):
        small += ["--data.extractor.n_features", "20"]
    if extractor["init_args"].get("backbone") == "resnet50":
        small += ["--data.extractor.backbone", "efficientnet_lite0"]  # needs no download
    assert workplace.command("fit", "--config", config, "--data.root", room, *small) == 0
    (run,) = workplace.runs()
    baselines = [name for name, entry in BASELINES.items() if entry.clips == (kind == "ClipDataModule")]
    _check_record(run.info.status, run.data.metrics, run.data.tags, baselines)
    table = capsys.readouterr().out
    for system in [run.data.tags["architecture"], *baselines]:
        assert f" {system} " in table
    of_map = MAP_FIGURES if "test/accepted" in run.data.metrics else set()
    of_radii = {"calibration.png"} if "test/coverage_position" in run.data.metrics else set()
    _check_artifacts(workplace, run.info.run_id, room, FIGURES[kind] | of_map | of_radii)


def _check_record(status: str, metrics: dict[str, float], tags: dict[str, str], baselines: list[str]) -> None:
    assert status == "FINISHED"
    assert (tags["scene"], tags["dataset"], tags["ground_truth"]) == ("small", "7scenes", "synthetic")
    groups = ["test", *(f"baseline/{name}" for name in baselines)]
    expected = {f"{group}/{name}" for group in groups for name in ERRORS}
    expected |= {f"cost/{name}" for name in COSTS} | {"test/skill_position", "test/skill_orientation"}
    expected |= {"train/loss", "val/loss", "val/position_median_m", "val/orientation_median_deg"}
    assert expected <= metrics.keys()
    assert all(np.isfinite(metrics[name]) for name in expected)


def _check_artifacts(workplace: Workplace, run_id: str, room: Path, figures: set[str]) -> None:
    def kept(folder: str) -> set[str]:
        return {Path(file.path).name for file in workplace.client.list_artifacts(run_id, folder)}

    assert "config.yaml" in kept("")
    assert kept("checkpoints") == {"best.ckpt", "last.ckpt"}
    assert kept("figures") == figures
    assert kept("trajectories") == {"truth", "predictions"}
    assert kept("trajectories/truth") == kept("trajectories/predictions") != set()
    images = sorted(room.glob("seq-*/*.png"))[:2]
    mlflow.set_tracking_uri(workplace.uri)
    poses = mlflow.pyfunc.load_model(f"runs:/{run_id}/model").predict(
        pd.DataFrame({"image": [image.read_bytes() for image in images]})
    )
    assert list(poses.columns)[:7] == ["x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"]
    assert len(poses) == 2


def _class_of(class_path: str) -> type:
    module, _, name = class_path.rpartition(".")
    return getattr(__import__(module, fromlist=[name]), name)
