"""A scene far from its origin, or in another unit, from its folder to metrics and files."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import Workplace

UTM = np.array([503123.45, 5413876.11, 431.2])
ERRORS = ("test/position_median_m", "test/position_p95_m", "baseline/oracle/position_median_m")


def move_scene(source: Path, root: Path, shift: np.ndarray, scale: float) -> Path:
    """A copy of a scene in 7-Scenes layout with other positions."""
    shutil.copytree(source, root)
    for file in root.glob("seq-*/*.pose.txt"):
        T = np.loadtxt(file)
        T[:3, 3] = (T[:3, 3] + shift) * scale
        np.savetxt(file, T, fmt="%.12g")
    return root


def fit_scene(workplace: Workplace, root: Path) -> tuple[Mapping[str, float], np.ndarray]:
    """Metrics of a run, and the positions that `predict` writes, (M, 3)."""
    small = "--trainer.max_epochs", "1", "--seed_everything", "0", "--report.log_model", "false"
    assert workplace.run("fit", "--data.root", root, *small) == 0
    run = workplace.runs()[0]
    assert workplace.command("predict", "--ckpt_path", workplace.checkpoint(run, "best")) == 0
    (file,) = workplace.folder.glob(f"mlruns/predictions/*-{root.name}/*.tum")
    return run.data.metrics, np.loadtxt(file)[:, 1:4]


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory, scene: Path, store: Path) -> tuple[Mapping[str, float], np.ndarray]:
    return fit_scene(Workplace.make(tmp_path_factory.mktemp("still") / "workplace", scene, store), scene)


@pytest.mark.parametrize(("shift", "scale"), [(UTM, 1.0), (0 * UTM, 1000.0), (0 * UTM, 0.001)])
def test_errors_and_predictions_are_those_of_the_scene_as_it_was(
    workplace: Workplace,
    still: tuple[Mapping[str, float], np.ndarray],
    shift: np.ndarray,
    scale: float,
    tmp_path: Path,
) -> None:
    metrics, position_m = fit_scene(workplace, move_scene(workplace.scene, tmp_path / "moved", shift, scale))
    for name in ERRORS:
        assert metrics[name] / scale == pytest.approx(still[0][name], rel=1e-3), name
    assert metrics["test/orientation_median_deg"] == pytest.approx(still[0]["test/orientation_median_deg"], rel=1e-3)
    np.testing.assert_allclose(position_m / scale - shift, still[1], atol=1e-4)
