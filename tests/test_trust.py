"""Checkpoints from strangers: which classes they may name, and damage that is noticed."""

from __future__ import annotations

import contextlib
import pickle
import random
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lightning_pose.checkpoint import build_object, read_checkpoint
from lightning_pose.errors import CheckpointError
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.trained_system import TrainedSystem
from tests.helpers import Trained

CHECKPOINT = Path(__file__).parent / "checkpoint" / "files" / "surf_lstm_0_1.ckpt"
EVIL = """
from pathlib import Path
from lightning_pose.models import SurfLSTM
Path(MARKER).touch()
class Net(SurfLSTM):
    pass
class Backbone:
    pass
"""


@pytest.fixture
def marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that appears when the module `evil_pose` is imported, which Python finds."""
    (tmp_path / "evil_pose.py").write_text(f"MARKER = {str(tmp_path / 'ran')!r}{EVIL}")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "evil_pose", raising=False)
    return tmp_path / "ran"


def write_checkpoint(folder: Path, **changes: Any) -> Path:
    """A copy of a checkpoint with other values at dotted places of its specs."""
    checkpoint = torch.load(CHECKPOINT, weights_only=True)
    for place, value in changes.items():
        *path, last = place.split("__")
        inner = checkpoint["lightning_pose"]
        for name in path:
            inner = inner[name]
        inner[last] = value
    torch.save(checkpoint, folder / "stranger.ckpt")
    return folder / "stranger.ckpt"


SPECS = [
    {"model": {"class_path": "os.system", "init_args": {"command": "touch ran"}}},
    {"model": {"class_path": "subprocess.run", "init_args": {"args": ["touch", "ran"]}}},
    {"model": {"class_path": "runpy.run_path", "init_args": {"path_name": "evil_pose.py"}}},
    {"model": {"class_path": "builtins.exec", "init_args": {}}},
    {"model__class_path": "evil_pose.Net"},
    {"model__class_path": "lightning_pose.features.surf.os.system"},
    {"model__class_path": "lightning_pose.models.base.torch"},
    {"model__class_path": "lightning_pose.models.base.LightningModule"},
    {"model__class_path": "lightning_pose.scenes.synthetic.write_room"},
    {"model__class_path": "lightning_pose.__main__.main"},
    {"model__init_args__loss": {"class_path": "evil_pose.Net"}},
    {"data__init_args__extractor": {"class_path": "evil_pose.Net", "init_args": {}}},
    {"data__init_args__extractor": "evil_pose.Net"},
    {"data__init_args__extractor": {"class_path": "lightning_pose.models.SurfLSTM", "init_args": {}}},
    {"data__init_args": {"extractor.class_path": "evil_pose.Net"}},
    {"data__class_path": "evil_pose.Net"},
    {
        "data__init_args__extractor": {
            "class_path": "lightning_pose.features.CNN",
            "init_args": {"backbone": "evil_pose.Backbone"},
        }
    },
    {"model": {"class_path": "lightning_pose.models.PoseNet", "init_args": {"backbone": "evil_pose.Backbone"}}},
    {
        "data__init_args__extractor": {
            "class_path": "lightning_pose.features.CNN",
            "init_args": {"backbone": "torchvision.models.os.getcwd"},
        }
    },
    {"model": None},
    {"model": []},
    {"model": {"class_path": 3}},
    {"model__init_args": None},
    {"data": {}},
]


@pytest.mark.parametrize("changes", SPECS, ids=str)
def test_a_stranger_s_checkpoint_runs_nothing(
    changes: dict[str, Any], marker: Path, tmp_path: Path, trained: Trained, capsys: pytest.CaptureFixture[str]
) -> None:
    file = write_checkpoint(tmp_path, **changes)
    with pytest.raises(CheckpointError):
        Localizer.load(file)
    for verb in ("predict", "test", "validate"):
        assert trained.workplace.command(verb, "--ckpt_path", file, allow=()) == 2
    for words in (("localize", file, tmp_path), ("export", file, "--out", "out"), ("export-map", file, "out")):
        assert trained.workplace.command(*words) == 2
    assert not marker.exists()
    assert not (trained.workplace.folder / "ran").exists()
    assert "Traceback" not in capsys.readouterr().err


class Evil:
    """Pickled, it asks whoever reads it to make a file."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.marker,)


@pytest.mark.parametrize("as_zip", [True, False])
def test_a_pickle_in_a_checkpoint_is_not_run(as_zip: bool, marker: Path, tmp_path: Path) -> None:
    checkpoint = torch.load(CHECKPOINT, weights_only=True)
    file = tmp_path / "stranger.ckpt"
    for place in ("state_dict", "lightning_pose", "hyper_parameters"):
        torch.save(checkpoint | {place: Evil(marker)}, file, _use_new_zipfile_serialization=as_zip)
        for read in (read_checkpoint, Localizer.load):
            with pytest.raises(CheckpointError, match="cannot be read as a checkpoint"):
                read(file)
    assert not marker.exists()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps(Evil(marker)))
    with pytest.raises(CheckpointError):
        read_checkpoint(file)
    file.write_bytes(pickle.dumps(Evil(marker)))
    with pytest.raises(CheckpointError):
        read_checkpoint(file)
    assert not marker.exists()


def test_a_refused_class_is_named_with_the_remedy(marker: Path, tmp_path: Path) -> None:
    file = write_checkpoint(tmp_path, model__class_path="evil_pose.Net")
    with pytest.raises(CheckpointError, match=r"names evil_pose.Net, which is not .*--allow evil_pose.Net, or in Py"):
        Localizer.load(file)
    with pytest.raises(CheckpointError, match=r"names evil_pose\.Net"):
        Localizer.load(file, allow=["evil"])
    for allow in ("evil_pose.Net", ["evil_pose"]):
        assert type(TrainedSystem.from_checkpoint(file, allow=allow).model).__name__ == "Net"
    assert marker.exists()


def test_the_command_line_allows_a_class(trained: Trained, capsys: pytest.CaptureFixture[str]) -> None:
    """The checkpoint names an extractor of the tests."""
    workplace, options = trained.workplace, ("predict", "--ckpt_path", trained.best)
    assert workplace.command(*options, allow=()) == 2
    assert "--allow tests.helpers.Thumbnails" in capsys.readouterr().err
    for allow in ("tests.helpers.Thumbnails", "tests"):
        assert workplace.command(*options, allow=[allow]) == 0
    assert workplace.command(*options, f"--allow={allow}", allow=()) == 0
    assert workplace.command(*options, "--config", workplace.config, allow=()) == 0  # it names the class
    assert "--allow" in help_of("test", workplace, capsys)


def help_of(verb: str, workplace: Any, capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    with pytest.raises(SystemExit):
        workplace.command(verb, "--help")
    return capsys.readouterr().out


@pytest.mark.parametrize("backbone", ["torchvision.models.resnet18", "torchvision.models.resnet.resnet18"])
def test_torchvision_s_own_networks_are_allowed(backbone: str) -> None:
    spec = {"class_path": "lightning_pose.features.CNN", "init_args": {"backbone": backbone}}
    assert build_object(spec).backbone == backbone


def test_no_damage_changes_an_answer(tmp_path: Path) -> None:
    """Single bytes, and pages of zeros, anywhere in the file: refused, or without effect."""
    whole, rng = CHECKPOINT.read_bytes(), random.Random(0)
    weights = read_checkpoint(CHECKPOINT)["state_dict"]
    file, refused = tmp_path / "damaged.ckpt", 0
    for number in range(300):
        damaged, start = bytearray(whole), rng.randrange(len(whole))
        if number % 3:
            damaged[start] ^= 1 << rng.randrange(8)
        else:
            damaged[start : start + 512] = bytes(len(damaged[start : start + 512]))
        file.write_bytes(damaged)
        found: dict[str, torch.Tensor] | None = None
        with contextlib.suppress(CheckpointError):
            found = read_checkpoint(file)["state_dict"]
        refused += found is None
        if found is not None:
            assert found.keys() == weights.keys()
            assert all(np.array_equal(found[name], value, equal_nan=True) for name, value in weights.items())
    assert refused > 200


def test_features_that_the_model_cannot_read(tmp_path: Path) -> None:
    file = write_checkpoint(tmp_path, data__init_args__extractor__init_args__with_geometry=True)
    with pytest.raises(
        CheckpointError, match=r"features have the shape \(\d+, 68\), and its SurfLSTM reads \(\d+, 64\)"
    ):
        Localizer.load(file).localize(np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8))


@pytest.mark.parametrize(
    ("name", "value"),
    [("units", "8"), ("units", True), ("bidirectional", {"init_args": True}), ("cell", "gnu"), ("input_shape", 5)],
)
def test_settings_of_another_type(name: str, value: object, tmp_path: Path) -> None:
    file = write_checkpoint(tmp_path, **{f"model__init_args__{name}": value})
    with pytest.raises(CheckpointError, match=rf"the checkpoint has {name} = .* for lightning_pose.models.SurfLSTM"):
        Localizer.load(file)
