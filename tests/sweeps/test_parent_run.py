"""The study's own run: who ends it, and what becomes of one that is deleted."""

from __future__ import annotations

from typing import Any

import optuna
import pytest
import yaml

from lightning_pose.commands import sweep
from tests.helpers import Workplace


def test_a_run_that_is_deleted_meanwhile_is_made_anew(workplace: Workplace, monkeypatch: pytest.MonkeyPatch) -> None:
    run = sweep._run

    def and_delete(study: optuna.Study, *args: Any) -> None:
        run(study, *args)
        workplace.client.delete_run(study.user_attrs["mlflow_run"])

    monkeypatch.setattr(sweep, "_run", and_delete)
    file = workplace.folder / "units.yaml"
    entries = {"base": "tiny.yaml", "settings": {"trainer.max_epochs": 1}, "space": {"model.units": [4]}}
    file.write_text(yaml.safe_dump(entries))
    assert workplace.command("sweep", file, "--n_trials", "1") == 0
    (parent,) = (run for run in workplace.runs() if "mlflow.parentRunId" not in run.data.tags)
    assert parent.info.status == "FINISHED"
    assert "best.yaml" in {file.path for file in workplace.client.list_artifacts(parent.info.run_id)}
