"""The catalogue and what a test logs have the same names, and importing it loads no library."""

from __future__ import annotations

import subprocess
import sys

import pytest
import yaml

from lightning_pose.errors import ConfigError
from lightning_pose.metrics import catalog
from lightning_pose.sweeps.plan import read_plan
from tests.helpers import Trained, Workplace
from tests.test_clip_cli import clip_run

__all__ = ["clip_run"]

GROUPS = ("test", "baseline", "cost")


def logged_names(run: Trained) -> set[str]:
    """The metrics that the test at the end of `fit` logs, without the terms of the model's own loss."""
    names = {name for name in run.run.data.metrics if name.partition("/")[0] in GROUPS}
    return {name for name in names if not name.startswith("test/loss")}


def expected_names(clips: bool) -> set[str]:
    """The same by the catalogue."""
    baselines = [name for name, baseline in catalog.BASELINES.items() if baseline.clips == clips]
    names = {f"test/{name}" for name in catalog.SKILLS} | {f"cost/{name}" for name in catalog.COSTS}
    names |= {f"{group}/{name}" for group in ("test", *map("baseline/{}".format, baselines)) for name in catalog.ERRORS}
    if clips:
        tracked = ["test", "baseline/visual_odometry"]
        curves = [name for name in catalog.CURVES if name.startswith("drift")]
        names |= {f"{group}/{name}" for group in tracked for name in (*catalog.TRAJECTORY, *curves)}
        names -= {"test/failed_steps"}
        by_length = set(catalog.CURVES) - set(curves)
        names |= {f"{group}/{name}" for group in ("test", *map("baseline/{}".format, baselines)) for name in by_length}
    return names


def test_a_test_of_images_logs_what_the_catalogue_has(trained: Trained) -> None:
    assert logged_names(trained) == expected_names(clips=False)


def test_a_test_of_clips_logs_what_the_catalogue_has(clip_run: Trained) -> None:
    assert logged_names(clip_run) == expected_names(clips=True)


def test_skill_is_relative_to_retrieval_or_to_no_motion() -> None:
    assert (catalog.reference_baseline(clips=False), catalog.reference_baseline(clips=True)) == (
        "retrieval_top1",
        "no_motion",
    )


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("test/position_median_m", 0.1234, "0.123"),
        ("test/recall_5cm_5deg", 0.456, "46%"),
        ("cost/parameters", 98765.0, "98,765"),
        ("cost/checkpoint_bytes", 123456.0, "123 kB"),
        ("cost/checkpoint_bytes", 999.0, "999 B"),
        ("cost/train_seconds", 1234.5, "1,234"),
        ("cost/train_seconds", 12.34, "12.3"),
    ],
)
def test_values_are_formatted(name: str, value: float, text: str) -> None:
    metric = catalog.find_metric(name)
    assert metric is not None
    assert metric.format(value) == text


def test_recalls_alone_are_better_when_higher() -> None:
    assert catalog.find_metric("val/unknown") is None
    assert {name for name, metric in catalog.ERRORS.items() if metric.higher_is_better} == {
        name for name in catalog.ERRORS if name.startswith("recall")
    }


@pytest.mark.parametrize(
    ("metric", "maximize"), [("val/recall_5cm_5deg", True), ("val/position_p95_m", False), ("cost/frame_bytes", False)]
)
def test_sweeps_take_the_direction_of_a_metric(metric: str, maximize: bool, workplace: Workplace) -> None:
    file = workplace.folder / "sweep.yaml"
    file.write_text(yaml.safe_dump({"base": "tiny.yaml", "space": {"model.units": [4, 8]}, "objective": metric}))
    (objective,) = read_plan(file, {}).objectives
    assert (objective.metric, objective.maximize) == (metric, maximize)


def test_what_trials_do_not_measure_is_no_objective(workplace: Workplace) -> None:
    file = workplace.folder / "sweep.yaml"
    entries = {"base": "tiny.yaml", "space": {"model.units": [4, 8]}, "objective": "cost/checkpoint_bytes"}
    file.write_text(yaml.safe_dump(entries))
    with pytest.raises(ConfigError, match="objective cost/checkpoint_bytes is not known"):
        read_plan(file, {})


def test_importing_it_loads_no_library() -> None:
    code = "import sys, lightning_pose.metrics.catalog; print({'torch', 'numpy', 'pandas'} & set(sys.modules))"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "set()"
