"""The verb `report`: every format, what it refuses, and that it is quick because it imports little."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

from lightning_pose.__main__ import main
from tests.helpers import REPOSITORY, Trained
from tests.stores import FakeRun, make_store, many_runs

HEAVY = ("mlflow", "lightning", "torch", "optuna", "pandas", "sqlalchemy", "numpy", "matplotlib", "cv2")

COSTS = {
    "cost/parameters": 375807.0, "cost/train_seconds": 84.25, "cost/ms_per_frame": 0.5,
    "cost/features_ms_per_frame": 9.5, "cost/frame_bytes": 12800.0, "cost/checkpoint_bytes": 1.5e6,
    "test/skill_position": 1.61, "test/skill_orientation": 0.96,
    "baseline/oracle/position_median_m": 0.094, "baseline/oracle/orientation_median_deg": 2.9,
}  # fmt: skip
KITCHEN = {"test_frames": "150"}
RUNS = [
    FakeRun("SurfLSTM", "redkitchen", (0.187, 6.3), 0.2, tags=KITCHEN, params={"model.units": "100"}, metrics=COSTS),
    FakeRun("SurfLSTM", "redkitchen", (0.1, 1.0), 0.3, tags=KITCHEN, params={"model.units": "50"}, metrics=COSTS),
    FakeRun("SurfLSTM", "my_room", (0.251, 8.0), day=2, params={"model.units": "100"}, metrics=COSTS),
    FakeRun("NodePose", "redkitchen", (0.0984, 6.5), day=3, tags={**KITCHEN, "features": "cnn"}),
]


@pytest.fixture
def uri(tmp_path: Path, store: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    made = make_store(tmp_path / "mlflow.db", store, RUNS)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", made)
    return made


def printed(capsys: pytest.CaptureFixture[str], *args: str, code: int = 0) -> tuple[str, str]:
    """What a report says on standard output and standard error."""
    assert main(["report", *args]) == code
    return capsys.readouterr()


@pytest.mark.usefixtures("uri")
def test_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    out, err = printed(capsys, "--published", "--chapter", "2", "--baselines", "--costs", "--skill")
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in out.splitlines() if line.startswith("│")]
    table = {row[0]: row[1:] for row in rows}
    assert table["NodePose"][:4] == ["cnn", "0.098 / 6.50", "–", "0.098 / 6.50 [1 of 2]"]
    assert table["SurfLSTM"] == [
        "surf", "0.187 / 6.30", "0.251 / 8.00", "0.219 / 7.15", "1.61 / 0.96",
        "375,807", "", "", "84.2", "0.5", "9.5", "12.8 kB", "", "1.5 MB",
    ]  # fmt: skip
    assert table["oracle"][1] == "0.094 / 2.90"
    assert table["SurfCNN 300 †"][:2] == ["table 2.3", "0.37 / 10.25"]
    assert "redkitchen: absolute poses, official split, original ground truth, images 640x480, 150 test frames" in out
    assert "redkitchen is a cut, 150 test frames of 5000" in out
    assert "† published, not measured here: A. Elmoogy" in out
    assert err == ""


@pytest.mark.usefixtures("uri")
def test_markdown(capsys: pytest.CaptureFixture[str]) -> None:
    out, err = printed(capsys, "--format", "markdown", "--published", "--chapter", "3")
    lines = out.splitlines()
    assert lines[:4] == [
        "| system | features | redkitchen | my_room | mean |",
        "| --- | --- | ---: | ---: | ---: |",
        "| NodePose | cnn | **0.098** / 6.50 | – | 0.098 / 6.50 [1 of 2] |",
        "| SurfLSTM | surf | 0.187 / **6.30** | 0.251 / 8.00 | 0.219 / 7.15 |",
    ]
    assert "| SurfCNN † | table 3.2 | 0.37 / 10.25 | – | 0.370 / 10.25 [1 of 2] |" in lines
    assert any(line.startswith("- † published, not measured here") for line in lines)
    assert err == ""


@pytest.mark.usefixtures("uri")
def test_latex(capsys: pytest.CaptureFixture[str]) -> None:
    out, err = printed(capsys, "--format", "latex", "--published", "--chapter", "3")
    assert r"system & features & redkitchen & my\_room & mean \\" in out
    assert r"NodePose & cnn & \textbf{0.098} / 6.50 & -- & 0.098 / 6.50 [1 of 2] \\" in out
    assert r"SurfCNN $^{\dagger}$ & table 3.2 & 0.37 / 10.25" in out
    assert r"$^{\dagger}$ published, not measured here" in out
    for word in ("toprule", "midrule", "bottomrule", "end{tabular}"):
        assert f"\\{word}" in out
    assert "note: a mean marked" in err


@pytest.mark.usefixtures("uri")
def test_csv_is_tidy(capsys: pytest.CaptureFixture[str]) -> None:
    out, err = printed(capsys, "--format", "csv", "--by", "model.units", "--baselines", "--published", "--chapter", "2")
    rows = list(csv.DictReader(io.StringIO(out)))
    own = {(row["system"], row["scene"]): row for row in rows if row["kind"] == "own"}
    assert len(own) == 7, "four cells and three means"
    row = own["SurfLSTM (units=100)", "redkitchen"]
    assert (row["position_median_m"], row["orientation_median_deg"], row["n"]) == ("0.187", "6.3", "1")
    assert (row["model.units"], row["features"], row["test_frames"]) == ("100", "surf", "150")
    assert (row["train_seconds"], row["skill_position"]) == ("84.25", "1.61")
    assert row["runs"] == f"{0:032x}"
    assert {row["kind"] for row in rows} == {"own", "baseline", "published"}
    assert next(row for row in rows if row["system"] == "PoseNet")["source"] == "table 2.3"
    assert err.startswith("note: ")
    pandas = pytest.importorskip("pandas")
    wide = pandas.read_csv(io.StringIO(out)).pivot_table(index="system", columns="scene", values="position_median_m")
    assert wide.loc["SurfLSTM (units=100)", "my_room"] == 0.251


@pytest.mark.usefixtures("uri")
def test_json_has_everything(capsys: pytest.CaptureFixture[str]) -> None:
    out, err = printed(capsys, "--format", "json", "--published", "--chapter", "2")
    report = json.loads(out)
    assert [scene["name"] for scene in report["scenes"]] == ["redkitchen", "my_room"]
    assert report["scenes"][0]["test_frames"] == "150"
    lstm = next(row for row in report["rows"] if row["system"] == "SurfLSTM")
    assert lstm["means"]["mean"] == {
        "position_median_m": pytest.approx(0.219), "orientation_median_deg": pytest.approx(7.15), "scenes": 2,
    }  # fmt: skip
    (run,) = lstm["cells"]["redkitchen"]["runs"]
    assert (run["run_id"], run["settings"]["model.units"]) == (f"{0:032x}", "100")
    assert lstm["cells"]["redkitchen"]["candidates"] == 2
    assert lstm["costs"]["parameters"] == 375807
    assert report["sources"][0].startswith("published, not measured here")
    assert report["notes"]
    assert err == ""


def test_numbers_that_are_none_are_null(tmp_path: Path, store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    uri = make_store(tmp_path / "mlflow.db", store, [FakeRun(test=(math.inf, math.nan)), FakeRun("NodePose")])
    out, _ = printed(capsys, "--format", "json", "--tracking_uri", uri)
    cell = next(row for row in json.loads(out)["rows"] if row["system"] == "SurfLSTM")["cells"]["chess"]
    assert (cell["position_median_m"], cell["orientation_median_deg"]) == (None, None)
    out, _ = printed(capsys, "--format", "markdown", "--tracking_uri", uri)
    assert "| SurfLSTM | surf | inf / nan | inf / nan |" in out
    assert "| NodePose | surf | **0.200** / **8.00** |" in out


def test_spread(tmp_path: Path, store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = [FakeRun(test=(0.1 + i / 10, 5.0 + i), params={"seed": str(i)}) for i in range(3)]
    uri = make_store(tmp_path / "mlflow.db", store, runs)
    out, _ = printed(capsys, "--pick", "spread", "--format", "markdown", "--tracking_uri", uri)
    assert "| SurfLSTM | surf | 0.200 ± 0.100 / 6.00 ± 1.00 (n=3) | 0.200 / 6.00 |" in out
    out, _ = printed(capsys, "--pick", "spread", "--format", "latex", "--tracking_uri", uri)
    assert r"0.200 $\pm$ 0.100 / 6.00 $\pm$ 1.00 (n=3)" in out


@pytest.mark.usefixtures("uri")
@pytest.mark.parametrize(
    ("suffix", "begins"),
    [(".md", "| system"), (".tex", "% \\use"), (".csv", "kind,"), (".json", "{"), ("", "┏")],
)
def test_a_file_by_its_name(suffix: str, begins: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "new" / f"report{suffix}"
    out, err = printed(capsys, "--out", str(file))
    assert file.read_text().startswith(begins)
    assert file.read_text().endswith("\n")
    assert out == ""
    assert err.splitlines()[-1] == str(file)


@pytest.mark.usefixtures("uri")
@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--scene", "fire"], "--scene fire matches no run; there is my_room, redkitchen"),
        (["--tag", "split"], "--tag split has no value; give NAME=VALUE"),
        (["--since", "soon"], "'soon' is no date"),
        (["--chapter", "2"], "--chapter chooses among published rows; give --published as well"),
        (["--chapter", "7", "--published"], "invalid choice: 7"),
        (["--format", "excel"], "invalid choice: 'excel'"),
        (["--by", "unit_s"], "no run has 'unit_s'"),
        (["--pick", "spread"], "2 runs differ in model.units (100, 50)"),
        (["--out", "/dev/null/report.md"], "--out /dev/null/report.md cannot be written"),
        (["--tracking_uri", "sqlite:///nowhere.db"], "sqlite:///nowhere.db does not exist"),
        (["redkitchen"], "unrecognized arguments: redkitchen"),
    ],
)
def test_a_mistake_is_one_line(args: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    out, err = printed(capsys, *args, code=2)
    assert out == ""
    assert err.startswith("error: ")
    assert says in err
    assert err.count("\n") == 1


def test_help_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["report", "--help"])
    assert stop.value.code == 0
    out = capsys.readouterr().out
    for words in ("report --published --baselines", "--pick spread", "--tag task=absolute", "Test errors never choose"):
        assert words in out


def test_a_thousand_runs_need_no_heavy_module(tmp_path: Path, store: Path) -> None:
    uri = make_store(tmp_path / "mlflow.db", store, many_runs(1000))
    script = f"""
import sys
from lightning_pose.__main__ import main
code = main(["report", "--published", "--baselines"])
print(*({{{", ".join(map(repr, HEAVY))}}} & set(sys.modules)), file=sys.stderr)
sys.exit(code)"""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "MLFLOW_TRACKING_URI": uri}
    process = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env=environment, check=False, cwd=tmp_path
    )
    assert (process.returncode, process.stderr.strip()) == (0, "")
    assert all(f"System{number}" in process.stdout for number in range(8))


def test_a_real_run(trained: Trained, capsys: pytest.CaptureFixture[str]) -> None:
    out, _ = printed(capsys, "--tracking_uri", trained.workplace.uri, "--format", "json", "--published", "--baselines")
    report = json.loads(out)
    assert report["scenes"] == [
        {
            "name": "wall", "task": "absolute", "dataset": "7scenes", "split": "official", "ground_truth": "original",
            "unit": "m", "image_size": "64x48", "test_frames": "10",
        }
    ]  # fmt: skip
    metrics = trained.run.data.metrics
    by_name = {row["system"]: row["cells"]["wall"] for row in report["rows"]}
    assert list(by_name) == ["SurfLSTM", "train_mean", "retrieval_top1", "retrieval_top5", "oracle"]
    assert by_name["SurfLSTM"]["position_median_m"] == metrics["test/position_median_m"]
    assert by_name["oracle"]["orientation_median_deg"] == metrics["baseline/oracle/orientation_median_deg"]
    assert "do not record" not in " ".join(report["notes"])
    assert "no published row" in " ".join(report["notes"])
