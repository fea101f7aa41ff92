"""Which run goes on: the newest of an architecture on a scene, however its folder is written."""

from __future__ import annotations

from pathlib import Path

import pytest

from lightning_pose.errors import CheckpointError
from lightning_pose.runs.last_run import find_last_run
from lightning_pose.runs.logger import MLflowLogger
from tests.helpers import Trained, Workplace


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
