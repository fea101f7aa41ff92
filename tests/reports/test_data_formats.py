"""A report for programs: CSV with a heading for each column and a line for each mean."""

from __future__ import annotations

import csv
import io

import pytest

from lightning_pose.reports.baseline_rows import add_baselines
from lightning_pose.reports.data_formats import as_csv
from lightning_pose.reports.published_rows import add_published
from lightning_pose.reports.table import SEVEN_SCENES, Report
from tests.stores import FakeRun

OUTDOORS = {"dataset": "cambridge", "ground_truth": "sfm"}


def lines(report: Report) -> list[dict[str, str]]:
    """Of a CSV file whose headings differ from each other."""
    heading = next(csv.reader(io.StringIO(as_csv(report))))
    assert len(heading) == len(set(heading))
    return list(csv.DictReader(io.StringIO(as_csv(report))))


@pytest.mark.parametrize("name", ["features", "scene", "split", "source", "kind"])
def test_what_is_a_column_already_gets_no_other(table, name: str) -> None:
    report = table(FakeRun(tags={"source": "mine", "kind": "mine"}), by=(name, "data.val_fraction"))
    cell, _ = lines(report)
    assert cell["data.val_fraction"] == "0.1"
    assert (cell["kind"], cell["features"], cell["scene"], cell["split"]) == ("own", "surf", "chess", "official")


def test_the_mean_is_a_line(table) -> None:
    cost = "cost/train_seconds"
    report = table(
        FakeRun(test=(0.1, 8.0), metrics={cost: 2.0, "baseline/oracle/position_median_m": 0.1}),
        FakeRun(scene="fire", test=(0.3, 6.0), metrics={cost: 4.0}, tags={"split": "blocks"}),
    )
    add_baselines(report)
    *cells, mean, oracle, its_mean = lines(report)
    assert [cell["scene"] for cell in cells] == ["chess", "fire"]
    assert (mean["system"], mean["kind"], mean["scene"], mean["n"]) == ("SurfLSTM", "own", "mean", "2")
    assert (float(mean["position_median_m"]), mean["orientation_median_deg"]) == (pytest.approx(0.2), "7.0")
    assert (mean["train_seconds"], mean["position_std_m"], mean["runs"]) == ("3.0", "", "")
    assert (mean["dataset"], mean["split"]) == ("7scenes", ""), "the scenes differ in their split"
    assert (oracle["scene"], its_mean["scene"], its_mean["n"]) == ("chess", "mean", "1")
    assert its_mean["position_median_m"] == "0.1"


def test_published_means_are_lines_of_their_own(table) -> None:
    report = table(*(FakeRun(scene=scene) for scene in SEVEN_SCENES), FakeRun(scene="KingsCollege", tags=OUTDOORS))
    add_published(report)
    found = {(line["system"], line["source"], line["scene"]): line for line in lines(report)}
    assert found["SurfLSTM", "", "mean 7scenes"]["n"] == "7"
    assert found["SurfLSTM", "", "mean cambridge"]["n"] == "1"
    atloc = found["AtLoc", "Wang 2020", "mean 7scenes"]
    assert (atloc["kind"], atloc["position_median_m"], atloc["orientation_median_deg"]) == ("published", "0.2", "7.56")
    assert (atloc["n"], atloc["dataset"]) == ("7", "")
    dense = found["Dense-PoseNet (ImageNet)", "table 5.2", "mean 7scenes"]
    assert float(dense["position_median_m"]) == pytest.approx(1.38 / 7)
