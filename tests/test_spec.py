"""Specs: objects to plain descriptions and back."""

from __future__ import annotations

from typing import Any

import pytest

from lightning_pose.errors import CheckpointError
from lightning_pose.spec import build, class_path, describe
from tests.helpers import Thumbnails


def test_a_description_is_plain_and_rebuilds() -> None:
    spec = describe(Thumbnails(rows=3, columns=4))
    assert spec == {"class_path": "tests.helpers.Thumbnails", "init_args": {"rows": 3, "columns": 4}}
    rebuilt = build(spec)
    assert isinstance(rebuilt, Thumbnails)
    assert rebuilt.feature_shape == (3, 4)


def test_class_path_of_a_builtin() -> None:
    assert class_path(1.0) == "builtins.float"


@pytest.mark.parametrize(
    ("path", "init_args", "says"),
    [
        ("nowhere.Thing", {}, "nowhere.Thing cannot be imported .*; install"),
        ("tests.helpers.Thing", {}, "tests.helpers.Thing cannot be imported .*; install"),
        ("Thing", {}, "Thing cannot be imported .*; install"),
        ("tests.helpers.Thumbnails", {"height": 3}, "does not take .*height.*; it was saved by another version"),
    ],
)
def test_what_cannot_be_rebuilt_is_refused(path: str, init_args: dict[str, Any], says: str) -> None:
    with pytest.raises(CheckpointError, match=says):
        build({"class_path": path, "init_args": init_args})
