"""Specs: objects to plain descriptions and back."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from lightning_pose.checkpoint import RENAMED_CLASSES, build_object, class_path, describe_object, resolve_class_paths
from lightning_pose.errors import CheckpointError
from lightning_pose.features import SURF
from lightning_pose.localization.localizer import Localizer
from tests.helpers import Thumbnails


def test_a_description_is_plain_and_rebuilds() -> None:
    spec = describe_object(Thumbnails(rows=3, columns=4))
    assert spec == {"class_path": "tests.helpers.Thumbnails", "init_args": {"rows": 3, "columns": 4}}
    rebuilt = build_object(spec, allow="tests")
    assert isinstance(rebuilt, Thumbnails)
    assert rebuilt.feature_shape == (3, 4)


def test_class_path_of_a_builtin() -> None:
    assert class_path(1.0) == "builtins.float"


@pytest.mark.parametrize(
    ("path", "init_args", "message"),
    [
        ("nowhere.Thing", {}, "nowhere.Thing cannot be imported .*; install"),
        ("tests.helpers.Thing", {}, "tests.helpers.Thing cannot be imported .*; install"),
        ("Thing", {}, "Thing cannot be imported .*; install"),
        ("tests.helpers.Thumbnails", {"height": 3}, "does not take .*height.*; it was saved by another version"),
    ],
)
def test_what_cannot_be_rebuilt_is_refused(path: str, init_args: dict[str, Any], message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        build_object({"class_path": path, "init_args": init_args}, allow=["nowhere", "tests", "Thing"])


CHECKPOINTS = Path(__file__).parent / "files"


@pytest.mark.parametrize(
    ("file", "position_m", "quat_wxyz"),
    [
        ("surf_lstm_0_1.ckpt", [0.582144, -0.058059, 2.371367], [0.706517, -0.706582, -0.039235, -0.006033]),
        ("orb_lstm_0_1.ckpt", [-0.461825, -0.403232, 0.454708], [0.656907, -0.743053, -0.126278, 0.019997]),
    ],
)
def test_a_checkpoint_of_version_0_1_answers_as_it_did(
    file: str, position_m: list[float], quat_wxyz: list[float]
) -> None:
    """Written before modules moved: it names `lightning_pose.models.surf_lstm.SurfLSTM` and others by their modules."""
    raw = torch.load(CHECKPOINTS / file, weights_only=True)["lightning_pose"]
    assert raw["model"]["class_path"] == "lightning_pose.models.surf_lstm.SurfLSTM"
    random = np.random.default_rng(0).uniform(0, 255, (12, 16)).astype(np.float32)
    image = cv2.resize(random, (160, 120), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)
    answer = Localizer.load(CHECKPOINTS / file).localize(image)
    np.testing.assert_allclose(answer.position_m, position_m, atol=1e-4)
    np.testing.assert_allclose(answer.quat_wxyz, quat_wxyz, atol=1e-4)


def test_every_renamed_class_exists() -> None:
    for old, new in RENAMED_CLASSES.items():
        module, _, name = new.rpartition(".")
        assert isinstance(getattr(import_module(module), name), type), old
        assert new not in RENAMED_CLASSES


def test_class_paths_are_those_that_users_import() -> None:
    assert class_path(SURF()) == "lightning_pose.features.SURF"
    nested = {"data": {"class_path": "lightning_pose.features.surf.SURF"}, "list": [{"class_path": "mine.Net"}]}
    assert resolve_class_paths(nested) == {
        "data": {"class_path": "lightning_pose.features.SURF"},
        "list": [{"class_path": "mine.Net"}],
    }
