"""The report at the end of a test: its numbers, its table, its files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from lightning_pose.evaluation.callback import describe_run
from lightning_pose.evaluation.costs import count_layers
from lightning_pose.evaluation.table import print_results
from lightning_pose.geometry.quaternions import orientation_error_deg, position_error_m
from lightning_pose.metrics.summary import summarize_errors
from lightning_pose.models import DensePoseNet, LinearPoseNet, NodePose, SurfCNN, SurfLSTM
from lightning_pose.models.base import PoseModule
from lightning_pose.runs.logger import MLflowLogger
from lightning_pose.runs.tags import NOTE
from lightning_pose.scenes.formats import load_scene
from tests.helpers import Trained, Workplace


def read_trajectory(trained: Trained, name: str) -> np.ndarray:
    path = trained.workplace.client.download_artifacts(trained.run.info.run_id, f"trajectories/{name}/seq-03.tum")
    return np.loadtxt(path)


def test_the_metrics_are_those_of_the_trajectories(trained: Trained) -> None:
    truth, prediction = (torch.from_numpy(read_trajectory(trained, name)) for name in ("truth", "predictions"))
    expected = summarize_errors(
        position_error_m(prediction[:, 1:4], truth[:, 1:4]),
        orientation_error_deg(prediction[:, [7, 4, 5, 6]], truth[:, [7, 4, 5, 6]]),
    )
    for name, value in expected.items():
        assert trained.run.data.metrics[f"test/{name}"] == pytest.approx(value, abs=1e-3), name


def test_the_truth_is_the_scene_s(trained: Trained, scene: Path) -> None:
    loaded = load_scene(scene)
    positions = [loaded.frames[i].position_m for i in loaded.splits["test"]]
    np.testing.assert_allclose(read_trajectory(trained, "truth")[:, 1:4], positions, atol=1e-6)


def test_baselines_by_hand(trained: Trained, scene: Path) -> None:
    loaded = load_scene(scene)
    train, test = (np.array([loaded.frames[i].position_m for i in loaded.splits[s]]) for s in ("train", "test"))
    metrics = trained.run.data.metrics
    to_mean = np.linalg.norm(test - train.mean(0), axis=1)
    to_nearest = np.linalg.norm(test[:, None] - train, axis=2).min(1)
    assert metrics["baseline/train_mean/position_median_m"] == pytest.approx(np.median(to_mean), abs=1e-5)
    assert metrics["baseline/oracle/position_median_m"] == pytest.approx(np.median(to_nearest), abs=1e-5)


def test_skill_is_model_error_over_retrieval_error(trained: Trained) -> None:
    metrics = trained.run.data.metrics
    for part, name in (("position", "position_median_m"), ("orientation", "orientation_median_deg")):
        ratio = metrics[f"test/{name}"] / metrics[f"baseline/retrieval_top1/{name}"]
        assert metrics[f"test/skill_{part}"] == pytest.approx(ratio)


def test_costs(trained: Trained) -> None:
    costs = {k.removeprefix("cost/"): v for k, v in trained.run.data.metrics.items() if k.startswith("cost/")}
    assert costs["parameters"] == 2 * 4 * 8 * (8 + 8 + 2) + 17 * 7
    assert costs["frame_bytes"] == 6 * 8 * 4
    assert costs["weights_bytes"] < costs["checkpoint_bytes"]
    assert costs["checkpoint_bytes"] == trained.best.stat().st_size
    assert all(value > 0 for value in costs.values())


@pytest.mark.parametrize("log_model", [True, False])
def test_the_model_is_kept_where_it_is_asked_for(log_model: bool, trained: Trained, workplace: Workplace) -> None:
    if log_model:
        assert list((trained.workplace.folder / "mlruns" / "artifacts" / "models").iterdir())
    else:
        assert workplace.run("fit", "--trainer.max_epochs", "1") == 0
        assert not (workplace.folder / "mlruns" / "artifacts" / "models").exists()


def test_figures_are_images(trained: Trained) -> None:
    folder = Path(trained.workplace.client.download_artifacts(trained.run.info.run_id, "figures"))
    files = sorted(folder.iterdir())
    assert [file.stem for file in files] == ["cumulative_errors", "error_vs_distance", "trajectory"]
    assert all(file.read_bytes().startswith(b"\x89PNG") for file in files)


def test_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    errors = (np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0]))
    results = {"SurfLSTM": summarize_errors(*errors), "oracle": summarize_errors(errors[0] / 10, errors[1])}
    print_results(results, "kitchen, N=50", {"test/skill_position": 0.5, "cost/parameters": 373000.0})
    lines = capsys.readouterr().out.splitlines()
    assert "kitchen, N=50" in lines[0]
    (row,) = (line for line in lines if "SurfLSTM" in line)
    assert [cell.strip() for cell in row.split("│")[2:6]] == ["0.200", "2.00", "0.200", "2.00"]
    assert lines.index(row) < next(i for i, line in enumerate(lines) if "oracle" in line)
    assert lines[-1].strip() == "skill position 0.5  parameters 373,000"


def test_retrieval_searches_what_the_model_has_learnt_from(workplace: Workplace, scene: Path) -> None:
    """A model that is solved again with the validation frames is compared with retrieval that may find them."""
    model = ["--model", "lightning_pose.models.LinearPoseNet", "--model.lambdas", "[1.0]"]
    pooled = ["--data.extractor", "lightning_pose.features.CNN", "--data.extractor.weights", "none"]
    oracles = {}
    for refit in ("true", "false"):
        assert workplace.run("fit", *model, "--model.refit", refit, *pooled, "--data.extractor.size", "32") == 0
        oracles[refit] = workplace.runs()[0].data.metrics["baseline/oracle/position_mean_m"]
    loaded = load_scene(scene)
    places = {split: np.array([loaded.frames[i].position_m for i in loaded.splits[split]]) for split in loaded.splits}
    for refit, known in (("false", places["train"]), ("true", np.concatenate([places["train"], places["val"]]))):
        nearest = np.linalg.norm(places["test"][:, None] - known, axis=2).min(1)
        assert oracles[refit] == pytest.approx(nearest.mean(), abs=1e-5)


@pytest.mark.parametrize(
    ("model", "layers"),
    [
        (SurfCNN(input_shape=[20, 64], channels=[4, 4, 4, 4, 4], units=8), 7),  # as table 2.2 counts
        (SurfLSTM(input_shape=[20, 64], units=8), 3),  # two recurrent ones and the output
        (DensePoseNet(input_shape=[32]), 4),
        (LinearPoseNet(input_shape=[32]), 1),
        (NodePose(input_shape=[32], channels=[8, 8, 8]), 5),  # three convolutions, position and orientation
    ],
    ids=lambda value: type(value).__name__,
)
def test_layers_are_counted_as_the_thesis_does(model: PoseModule, layers: int) -> None:
    assert count_layers(model.network) == layers  # type: ignore[arg-type]


def test_the_description_of_a_run_is_its_table_unless_a_user_wrote_one(trained: Trained, workplace: Workplace) -> None:
    tags, metrics = trained.run.data.tags, trained.run.data.metrics
    rows = [line.split(" | ") for line in tags[NOTE].splitlines()]
    assert rows[0][:3] == ["| test", "median m", "median deg"]
    assert rows[2][:2] == ["| **SurfLSTM**", f"{metrics['test/position_median_m']:.3f}"]
    assert [row[0] for row in rows[3:7]] == ["| train_mean", "| retrieval_top1", "| retrieval_top5", "| oracle"]
    assert {len(row) for row in rows[:1] + rows[2:7]} == {7}
    logger = MLflowLogger(tracking_uri=workplace.uri)
    for before, after in (("", tags[NOTE]), ("**the one to keep**", "**the one to keep**")):
        logger.client.set_tag(str(logger.run_id), NOTE, before)
        describe_run(logger, tags[NOTE])
        assert logger.client.get_run(str(logger.run_id)).data.tags[NOTE] == after
