"""A study of pretrained networks where some weights can be downloaded and others cannot."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.helpers import REPOSITORY, Workplace, write_scene


def test_what_cannot_be_downloaded_is_a_row_that_says_so(
    workplace: Workplace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError("no network")

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setenv("LIGHTNING_POSE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(torch.hub, "download_url_to_file", refuse)
    study = REPOSITORY / "sweeps" / "thesis" / "figure_5_2.yaml"
    weights = ["--space.data.extractor.weights", "[none, places365]"]  # random ones in the place of ImageNet's
    bases = ["--space.base", "[linear_posenet]"]
    few = write_scene(tmp_path / "few", train=(6, 6), test=2)  # a ResNet takes a tenth of a second an image
    assert workplace.command("sweep", study, "--data.root", few, *bases, *weights) == 0
    table = workplace.folder / "mlruns" / "sweeps" / "figure_5_2-few" / "table.md"
    rows = [line for line in table.read_text().splitlines() if "failed" in line]
    assert len(rows) == 1
    assert "the places365 weights of resnet50 cannot be downloaded (no network)" in rows[0]
    assert "resnet50_places365.pth.tar of the Places365 project" in rows[0], "where it comes from"
