"""The study's own run: which command ends it, and what happens to one that is deleted."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from lightning_pose.sweeps import workers
from tests.helpers import Workplace


def test_a_run_that_is_deleted_meanwhile_is_created_again(
    workplace: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_here = workers.run_here

    def and_delete(job: workers.Job, *args: Any) -> None:
        run_here(job, *args)
        workplace.client.delete_run(job.parent)

    monkeypatch.setattr(workers, "run_here", and_delete)
    file = workplace.folder / "units.yaml"
    entries = {"base": "tiny.yaml", "settings": {"trainer.max_epochs": 1}, "space": {"model.units": [4]}}
    file.write_text(yaml.safe_dump(entries))
    assert workplace.command("sweep", file, "--n_trials", "1") == 0
    (parent,) = (run for run in workplace.runs() if "mlflow.parentRunId" not in run.data.tags)
    assert parent.info.status == "FINISHED"
    assert "best.yaml" in {file.path for file in workplace.client.list_artifacts(parent.info.run_id)}
