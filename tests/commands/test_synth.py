"""The command `synth`: what it writes, prints and refuses."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from lightning_pose.commands.synth import main
from lightning_pose.errors import ConfigError


def test_renders_a_room_and_prints_the_next_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = tmp_path / "deep" / "room"
    assert main([str(root), "--seed", "3", "--frames", "6", "--size", "64x48"]) == 0
    assert len(list(root.rglob("*.color.png"))) == 6
    printed = capsys.readouterr().out
    assert f"{root} holds room 3: 6 frames of 64x48 pixels" in printed
    assert f"--data.root {root}" in printed


@pytest.mark.parametrize("size", ["320", "320x", "axb", "1x2x3"])
def test_a_malformed_size_is_one_line(tmp_path: Path, size: str) -> None:
    with pytest.raises(ConfigError, match=f"'{size}' is not a size; give WxH in pixels, like 320x240; `python -m"):
        main([str(tmp_path / "room"), "--size", size])


def test_a_value_out_of_range_is_a_pose_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="frames is 2"):
        main([str(tmp_path / "room"), "--frames", "2"])


def test_help_has_examples(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    printed = capsys.readouterr().out
    assert "7-Scenes layout" in printed
    assert "python -m lightning_pose synth rooms/1 --seed 1" in printed


def test_rendering_needs_no_torch() -> None:
    check = "import sys, lightning_pose.commands.synth; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", check], check=False).returncode == 0
