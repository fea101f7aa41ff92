"""Tables of made-up runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from lightning_pose.reports.choose_run import Pick
from lightning_pose.reports.table import Report, build_report
from lightning_pose.runs.reader import read_runs
from tests.stores import FakeRun, make_store


@pytest.fixture
def table(tmp_path: Path, store: Path) -> Callable[..., Report]:
    def make(*runs: FakeRun, pick: Pick = "best", by: tuple[str, ...] = ()) -> Report:
        return build_report(read_runs(make_store(tmp_path / "mlflow.db", store, runs)), pick, by)

    return make
