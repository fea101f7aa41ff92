"""Tracking: where runs go, how they are named and closed, which one goes on, and what MLflow keeps."""

from __future__ import annotations

import ast
import os
import shutil
import socket
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from lightning_pose.errors import CheckpointError
from lightning_pose.paths import default_tracking_uri
from lightning_pose.runs.logger import REQUIREMENTS, MLflowLogger, find_last_run, flatten_settings
from lightning_pose.runs.process import has_died, identify_machine, process_name
from tests.helpers import Trained, Workplace

DISTRIBUTIONS = {"PIL": "pillow", "cv2": "opencv-contrib-python-headless", "yaml": "PyYAML", "sklearn": "scikit-learn"}
"""Where a distribution's name is not that of its package."""

LIGHTNING_BRINGS = {"torchmetrics"}
MLFLOW_BRINGS = {"mlflow", "pandas"}


def dead_process() -> int:
    """The number of a process that is gone."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


@pytest.fixture
def logger(workplace: Workplace, monkeypatch: pytest.MonkeyPatch) -> MLflowLogger:
    monkeypatch.chdir(workplace.folder)
    return MLflowLogger(tracking_uri=workplace.uri)


def test_the_environment_names_the_store(monkeypatch: pytest.MonkeyPatch) -> None:
    assert default_tracking_uri() == "sqlite:///mlruns/mlflow.db"
    assert default_tracking_uri("/data/runs") == "sqlite:////data/runs/mlflow.db"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://tracker:5000")
    assert default_tracking_uri() == "http://tracker:5000"


def test_a_store_named_in_code_is_not_the_next_logger_s(tmp_path: Path, store: Path) -> None:
    for name in ("first", "second"):
        root = tmp_path / name
        root.mkdir()
        shutil.copy(store, root / "mlflow.db")
        logger = MLflowLogger(root=str(root))
        logger.client.set_tag(str(logger.run_id), "made", "by hand")
        assert logger.uri == f"sqlite:///{root}/mlflow.db"
    assert "MLFLOW_TRACKING_URI" not in os.environ


def test_settings_by_dotted_name() -> None:
    spec = {"class_path": "a.Net", "init_args": {"units": 8, "loss": {"form": "joint"}}}
    assert flatten_settings({"model": spec, "seed": 0}) == {
        "model.class_path": "a.Net",
        "model.units": 8,
        "model.loss.form": "joint",
        "seed": 0,
    }


def test_a_run_belongs_to_its_process(logger: MLflowLogger) -> None:
    tags = logger.client.get_run(str(logger.run_id)).data.tags
    assert tags["process.id"] == str(os.getpid())
    logger.finalize("success")
    assert logger.client.get_run(str(logger.run_id)).info.status == "FINISHED"


@pytest.mark.parametrize(
    ("process", "host", "status"),
    [
        ("dead", None, "KILLED"),
        ("alive", None, "RUNNING"),
        ("dead", "another machine", "RUNNING"),
        ("dead", f"{socket.gethostname()} 01234567", "RUNNING"),
    ],
)
def test_runs_whose_process_is_gone_are_closed(
    process: str, host: str | None, status: str, logger: MLflowLogger, workplace: Workplace
) -> None:
    run_id = str(logger.run_id)
    number = dead_process() if process == "dead" else os.getppid()
    logger.client.set_tag(run_id, "process.id", str(number))
    if host:
        logger.client.set_tag(run_id, "process.host", host)
    following = MLflowLogger(tracking_uri=workplace.uri)
    assert following.client.get_run(run_id).info.status == status
    assert following.client.get_run(str(following.run_id)).info.status == "RUNNING"


def test_a_machine_is_more_than_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another boot, or another machine of the same name, has processes of its own under the same numbers."""
    dead = f"{identify_machine()}:{dead_process()}"
    assert has_died(dead)
    assert not has_died(process_name())
    assert identify_machine().split()[0] == socket.gethostname()
    monkeypatch.setattr(Path, "read_text", lambda self: "another boot")
    identify_machine.cache_clear()
    try:
        assert identify_machine().split()[0] == socket.gethostname()
        assert not has_died(dead)
    finally:
        monkeypatch.undo()
        identify_machine.cache_clear()


@pytest.mark.parametrize(("began", "status"), [(1000, "KILLED"), (None, "RUNNING")])
def test_runs_from_before_the_machine_started_are_closed(
    began: int | None, status: str, logger: MLflowLogger, workplace: Workplace
) -> None:
    """As after a power failure; one of its name that began later is another machine's."""
    tags = {"process.host": f"{socket.gethostname()} 01234567", "process.id": str(os.getppid())}
    assert logger.client
    run_id = logger.client.create_run(str(logger.experiment_id), start_time=began, tags=tags).info.run_id
    following = MLflowLogger(tracking_uri=workplace.uri)
    assert following.client.get_run(run_id).info.status == status


@pytest.mark.parametrize(
    ("trial", "status"), [("dead", "KILLED"), ("alive", "RUNNING"), ("of another machine", "RUNNING")]
)
def test_a_sweep_s_run_is_not_closed_while_its_trials_live(
    trial: str, status: str, logger: MLflowLogger, workplace: Workplace
) -> None:
    """As when another command that worked at the study has ended."""
    parent = str(logger.run_id)
    logger.client.set_tag(parent, "process.id", str(dead_process()))
    number = os.getppid() if trial == "alive" else dead_process()
    host = "elsewhere" if trial == "of another machine" else identify_machine()
    tags = {"mlflow.parentRunId": parent, "process.host": host, "process.id": str(number)}
    logger.client.create_run(str(logger.experiment_id), tags=tags)
    following = MLflowLogger(tracking_uri=workplace.uri)
    assert following.client.get_run(parent).info.status == status


def test_a_run_that_goes_on_is_claimed(logger: MLflowLogger, workplace: Workplace) -> None:
    run_id = str(logger.run_id)
    logger.client.set_tag(run_id, "process.id", str(dead_process()))
    resumed = MLflowLogger(tracking_uri=workplace.uri, run_id=run_id)
    assert resumed.client.get_run(run_id).data.tags["process.id"] == str(os.getpid())
    following = MLflowLogger(tracking_uri=workplace.uri)
    assert following.client.get_run(run_id).info.status == "RUNNING"


def test_parameters_of_a_run_that_goes_on_may_differ(logger: MLflowLogger) -> None:
    logger.log_hyperparams({"trainer": {"max_epochs": 2}})
    logger.log_hyperparams({"trainer": {"max_epochs": 4}, "seed": 1})
    assert logger.client.get_run(str(logger.run_id)).data.params == {"trainer.max_epochs": "2", "seed": "1"}


def test_the_last_run_is_the_newest_of_that_architecture_and_scene(trained: Trained) -> None:
    def find(architecture: str, root: str) -> tuple[str, Path]:
        checkpoints = trained.workplace.folder / "mlruns" / "checkpoints"
        return find_last_run(trained.workplace.uri, "lightning_pose", checkpoints, architecture, {"root": root})

    root = str(trained.workplace.scene)
    assert find("SurfLSTM", root) == (trained.run.info.run_id, trained.last)
    with pytest.raises(CheckpointError, match=rf"no run of SurfCNN on data.root={root} .*; leave --ckpt_path out"):
        find("SurfCNN", root)
    with pytest.raises(CheckpointError, match=r"on data.root=elsewhere"):
        find("SurfLSTM", "elsewhere")


def test_a_run_that_lacks_a_newer_setting_is_found_by_its_default(trained: Trained) -> None:
    checkpoints = trained.workplace.folder / "mlruns" / "checkpoints"
    data = {"root": str(trained.workplace.scene), "newer": None}
    found = find_last_run(trained.workplace.uri, "lightning_pose", checkpoints, "SurfLSTM", data)
    assert found == (trained.run.info.run_id, trained.last)
    with pytest.raises(CheckpointError, match=r"data\.newer=set"):
        find_last_run(trained.workplace.uri, "lightning_pose", checkpoints, "SurfLSTM", data | {"newer": "set"})


@pytest.mark.parametrize(
    ("logged", "given", "same"),
    [
        ("/data/room", "/data/room/", True),
        ("/data/room", "/data/other/../room", True),
        ("room", "{here}/room", True),
        ("{here}/room/", "./room", True),
        ('a "quoted" room\'s', '{here}/a "quoted" room\'s', True),
        ("back\\slash", "back\\slash", True),
        ("~/room", "{home}/room", True),
        ("room", "rooms", False),
        ("None", None, True),
        ("None", "room", False),
        ("['a', 'b/']", ["a", "{here}/b"], True),
        ("['a', 'b']", ["a"], False),
    ],
)
def test_a_scene_is_the_same_however_its_folder_is_written(
    logged: str, given: str | list[str] | None, same: bool, workplace: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(workplace.folder)
    places = {"here": str(workplace.folder), "home": str(Path.home())}
    logger = MLflowLogger(tracking_uri=workplace.uri)
    logger.log_hyperparams({"data": {"root": logged.format(**places)}})
    run = str(logger.run_id)
    logger.client.set_tag(run, "architecture", "SurfLSTM")
    (workplace.folder / "checkpoints" / run).mkdir(parents=True)
    (workplace.folder / "checkpoints" / run / "last.ckpt").touch()
    filled = [part.format(**places) for part in given] if isinstance(given, list) else given and given.format(**places)
    search = workplace.uri, "lightning_pose", workplace.folder / "checkpoints", "SurfLSTM", {"root": filled}
    if same:
        assert find_last_run(*search)[0] == run
    else:
        with pytest.raises(CheckpointError, match="no run of SurfLSTM"):
            find_last_run(*search)


def test_no_experiment_has_no_last_run(workplace: Workplace) -> None:
    with pytest.raises(CheckpointError, match="no run of SurfLSTM"):
        find_last_run(workplace.uri, "lightning_pose", workplace.folder, "SurfLSTM", {"root": None})


def test_a_logged_model_names_all_that_it_imports() -> None:
    """Follow the imports of what a localizer needs, and compare with the requirements that MLflow installs."""
    todo, seen, needed = (
        ["lightning_pose.localization.mlflow_model", "lightning_pose.models", "lightning_pose.features"],
        set(),
        set(),
    )
    while todo:
        module = todo.pop()
        spec = find_spec(module)
        if module in seen or spec is None or spec.origin is None:
            continue
        seen.add(module)
        for name in _imported(Path(spec.origin)):
            (todo.append if name.startswith("lightning_pose") else needed.add)(name)
    packages = {name.partition(".")[0] for name in needed} - set(sys.stdlib_module_names)
    distributions = {DISTRIBUTIONS.get(package, package) for package in packages}
    assert distributions - LIGHTNING_BRINGS - MLFLOW_BRINGS <= set(REQUIREMENTS)


def _imported(file: Path) -> set[str]:
    """Modules that a file imports when it is imported itself."""
    names: set[str] = set()
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names
