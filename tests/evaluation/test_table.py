"""The table that a test prints."""

from __future__ import annotations

import numpy as np
import pytest

from lightning_pose.evaluation.table import print_results
from lightning_pose.metrics.summary import summarize_errors


def test_a_scene_s_name_is_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    errors = summarize_errors(np.array([0.1]), np.array([1.0]))
    print_results({"SurfLSTM": errors, "my[b]baseline": errors}, "room [a] :smile:, N=6", {})
    printed = capsys.readouterr().out
    assert "room [a] :smile:, N=6" in printed
    assert "my[b]baseline" in printed
