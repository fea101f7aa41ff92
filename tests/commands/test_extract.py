"""The command `extract`: it fills the cache, prints what it did, and extracts nothing twice."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.helpers import Workplace


def test_it_fills_the_cache_once(workplace: Workplace, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cache = ["--data.cache_dir", tmp_path / "cache"]
    assert workplace.run("extract", *cache) == 0
    first = capsys.readouterr().out
    assert re.match(r"34 frames: 34 extracted, 0 cached, 0 redone, \d+\.\d ms each\n", first)
    folder = Path(first.strip().rpartition("in ")[2])
    assert folder.is_relative_to(tmp_path / "cache")
    assert len(list(folder.rglob("*.safetensors"))) == 34
    assert workplace.run("extract", *cache) == 0
    assert capsys.readouterr().out.startswith("34 frames: 0 extracted, 34 cached, 0 redone")
    assert workplace.runs() == []


def test_fit_reads_what_extract_wrote(workplace: Workplace, tmp_path: Path) -> None:
    cache = ["--data.cache_dir", tmp_path / "cache"]
    assert workplace.run("extract", *cache) == 0
    before = {file: file.stat().st_mtime_ns for file in (tmp_path / "cache").rglob("*")}
    assert workplace.run("fit", *cache, "--trainer.max_epochs", "1") == 0
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "cache").rglob("*")} == before


def test_a_damaged_file_is_redone(workplace: Workplace, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cache = ["--data.cache_dir", tmp_path / "cache"]
    assert workplace.run("extract", *cache) == 0
    next((tmp_path / "cache").rglob("*.safetensors")).write_bytes(b"damaged")
    capsys.readouterr()
    assert workplace.run("extract", *cache) == 0
    assert "0 extracted, 33 cached, 1 redone" in capsys.readouterr().out


def test_a_wrong_setting_is_one_line(workplace: Workplace, capsys: pytest.CaptureFixture[str]) -> None:
    assert workplace.run("extract", "--data.extractor.rowz", "3") == 2
    line = capsys.readouterr().err
    assert "rowz" in line
    assert line.count("\n") == 1
