"""What `lightning_pose` itself gives its users, and what importing it leaves alone."""

from __future__ import annotations

import subprocess
import sys

import pytest

import lightning_pose
from lightning_pose import models
from lightning_pose.checkpoint import class_path
from lightning_pose.models import PoseModule


@pytest.mark.parametrize("name", lightning_pose.__all__)
def test_every_name_is_there(name: str) -> None:
    assert getattr(lightning_pose, name) is not None
    assert name in dir(lightning_pose)


def test_every_architecture_is_given() -> None:
    classes = {name for name in models.__all__ if issubclass(getattr(models, name), PoseModule)}
    assert classes - {"PoseModule", "ClipModule"} <= set(lightning_pose.__all__)
    assert lightning_pose.SurfLSTM is models.SurfLSTM


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'SurfLTSM'"):
        _ = lightning_pose.SurfLTSM  # pyright: ignore[reportAttributeAccessIssue]


def test_checkpoints_name_architectures_by_the_models_package() -> None:
    made = object.__new__(lightning_pose.SurfLSTM)
    assert class_path(made) == "lightning_pose.models.SurfLSTM"


def test_importing_the_package_does_not_import_torch() -> None:
    code = "import sys, lightning_pose; dir(lightning_pose); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
