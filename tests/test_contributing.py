"""The examples of CONTRIBUTING.md, extracted from the page and run through the code that they extend."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
import yaml

from lightning_pose import models
from lightning_pose.evaluation.baselines.images import evaluate_baselines
from lightning_pose.metrics.catalog import ERRORS
from lightning_pose.scenes import formats
from lightning_pose.scenes.formats import load_scene
from tests.helpers import REPOSITORY, Workplace

PAGE = (REPOSITORY / "CONTRIBUTING.md").read_text()


def extract_block(heading: str, language: str = "python") -> str:
    """The first fenced block in that language under a heading."""
    section = PAGE.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    match = re.search(rf"```{language}\n(.*?)```", section, re.DOTALL)
    assert match is not None, heading
    return match[1]


def import_block(heading: str, folder: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> ModuleType:
    """Write a section's Python block as a module of a temporary folder, and import it."""
    (folder / f"{name}.py").write_text(extract_block(heading))
    monkeypatch.syspath_prepend(folder)
    return __import__(name)


def test_every_python_block_is_run() -> None:
    headings = ("Add an architecture", "Add a dataset format", "Add a metric", "Add a baseline")
    assert PAGE.count("```python\n") == len(headings)
    assert all(extract_block(heading) for heading in headings)


def test_every_file_of_the_way_through_the_code_exists() -> None:
    table = PAGE.split("## The way through the code")[1].split("\n## ")[0]
    files = re.findall(r"`([\w/]+\.py)`", table)
    assert len(files) > 12
    assert [file for file in files if not (REPOSITORY / "lightning_pose" / file).is_file()] == []


def test_the_architecture_trains_through_the_command_line(
    workplace: Workplace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module = import_block("Add an architecture", tmp_path, monkeypatch, "contributed_mean_mlp")
    config = yaml.safe_load(extract_block("Add an architecture", "yaml"))
    assert config["model"]["class_path"] == "lightning_pose.models.MeanMLP"
    config["model"]["class_path"] = f"{module.__name__}.MeanMLP"
    config["data"]["init_args"]["root"] = str(workplace.scene)
    (workplace.folder / "mean_mlp.yaml").write_text(yaml.safe_dump(config))
    small = ["--trainer.max_epochs", "1", "--trainer.accelerator", "cpu", "--report.log_model", "false"]
    assert workplace.command("fit", "--config", workplace.folder / "mean_mlp.yaml", *small) == 0
    assert "MeanMLP" in capsys.readouterr().out
    (run,) = workplace.runs()
    assert np.isfinite(run.data.metrics["test/position_median_m"])
    assert "N=50 units=64" in str(run.info.run_name)
    assert issubclass(module.MeanMLP, models.PoseModule)


def test_the_format_is_recognised_and_read(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = import_block("Add a dataset format", tmp_path, monkeypatch, "contributed_pose_list")
    known = formats.known_formats() | {module.FORMAT.name: module.FORMAT}
    monkeypatch.setattr(formats, "known_formats", lambda: known)
    root = tmp_path / "listed"
    root.mkdir()
    images = sorted(scene.glob("*/*.color.png"))
    lines = []
    for i, image in enumerate(images):
        (root / f"{i:03d}.png").write_bytes(image.read_bytes())
        lines.append(f"{i:03d}.png,{i / 10},0,0,1,0,0,0\n")
    (root / "poses.csv").write_text("".join(lines))
    read = load_scene(root)
    assert (read.format, len(read.frames), read.split_source) == ("pose_list", len(images), "blocks")
    np.testing.assert_allclose(read.frames[3].position_m, [0.3, 0, 0])
    np.testing.assert_allclose(read.frames[3].quat_wxyz, [1, 0, 0, 0])
    assert all(len(read.splits[split]) for split in ("train", "val", "test"))


def test_the_metric_is_in_every_summary(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ERRORS, "recall_1m_10deg", ERRORS["recall_5m_10deg"])  # removed again after the test
    variables: dict[str, dict[str, float]] = {}
    exec(extract_block("Add a metric"), variables)
    assert variables["summary"]["recall_1m_10deg"] == pytest.approx(2 / 3)
    features, positions, quats = torch.eye(3), torch.eye(3), torch.eye(4)[:3]
    results = evaluate_baselines(features, positions, quats, features, positions, quats)
    assert all("recall_1m_10deg" in result.metrics for result in results.values())


def test_the_baseline_answers_for_every_test_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = import_block("Add a baseline", tmp_path, monkeypatch, "contributed_first_pose")
    positions, quats = torch.eye(3), torch.eye(4)[:3]
    result = module.locate_at_first_pose((positions, quats), (positions[:2], quats[:2]))
    assert (result.position_m.shape, result.quat_wxyz.shape) == ((2, 3), (2, 4))
    assert result.metrics["position_median_m"] == pytest.approx(2**0.5 / 2)
