"""Where caches are kept."""

from __future__ import annotations

from pathlib import Path

import pytest

from lightning_pose.paths import cache_folder


def test_the_environment_decides(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LIGHTNING_POSE_CACHE", str(tmp_path))
    assert cache_folder("rooms") == tmp_path / "rooms"
    monkeypatch.setenv("LIGHTNING_POSE_CACHE", "~/kept")
    assert cache_folder("rooms") == Path.home() / "kept" / "rooms"


def test_otherwise_the_user_s_cache_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("LIGHTNING_POSE_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))  # platforms without it have their own place
    folder = cache_folder("features")
    assert folder.name == "features"
    assert folder.parts[-2] in ("lightning_pose", "Cache")
