"""Ways to damage nested settings: a value replaced, removed, moved under another name, or wrapped."""

from __future__ import annotations

import copy
from typing import Any

from hypothesis import strategies as st

__all__ = ["Change", "apply_changes", "changes"]

VALUES: list[Any] = [
    *(None, True, False, 0, 1, -1, 7, 10**30, -(10**30), 0.5, -0.0, 1e-300, 1e300, float("nan"), float("inf")),
    *("", " ", "nan", "1e5", "0x10", "é\u202e", "a" * 300, "/", "..", "~", "null", "lightning_pose.models.SurfLSTM"),
    *([], [1], [None], ["a", 2], [[]], {}, {"a": 1}, {"class_path": "lightning_pose.features.SURF"}, {"": None}),
    *({"class_path": 3}, {"class_path": "os.system", "init_args": {"command": "false"}}, b"\xff", [0] * 50),
]
"""What stands in place of a setting."""

KINDS = ("replace", "remove", "rename", "wrap", "add")

Change = tuple[str, int, int]
"""What is done, to which setting, and with which value."""

changes = st.lists(
    st.tuples(st.sampled_from(KINDS), st.integers(0, 999), st.integers(0, len(VALUES) - 1)), min_size=1, max_size=3
)


def apply_changes(settings: dict[str, Any], chosen: list[Change]) -> dict[str, Any]:
    """A copy of nested settings after some changes."""
    settings = copy.deepcopy(settings)
    for kind, which, value in chosen:
        places = _list_places(settings)
        if not places:
            break
        inside, key = places[which % len(places)]
        new = copy.deepcopy(VALUES[value])
        if kind == "replace":
            inside[key] = new
        elif kind == "wrap":
            inside[key] = [inside[key]] if value % 2 else {"init_args": inside[key]}
        elif isinstance(inside, dict):
            if kind == "add":
                inside[str(new)[:20]] = new
            else:
                old = inside.pop(key)
                if kind == "rename":
                    inside[f"{key}s"] = old
    return settings


def _list_places(value: Any) -> list[tuple[Any, Any]]:
    """Every container in nested settings with each of its keys."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place for key, inner in items for place in [(value, key), *_list_places(inner)]]
