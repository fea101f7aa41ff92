"""The MLflow run of a study; the runs of its trials are nested in it."""

from __future__ import annotations

from mlflow import MlflowClient
from mlflow.exceptions import MlflowException
from optuna import Study
from optuna.trial import TrialState

from lightning_pose.runs.logger import MLflowLogger
from lightning_pose.runs.tags import RUN
from lightning_pose.sweeps.plan import Plan
from lightning_pose.sweeps.results import SHOWN, best_trials, count_states, format_value
from lightning_pose.terminal import format_markdown

__all__ = ["close_parent", "close_run", "describe_parent", "open_parent"]


def open_parent(study: Study, plan: Plan) -> tuple[MlflowClient, str]:
    """Reopen the study's MLflow run, or create it.

    Returns:
        A client, and the run's id.
    """
    uri, experiment = plan.tracking
    logger = plan.resolved["trainer"]["logger"]["init_args"]
    kept = study.user_attrs.get(RUN)
    if kept is not None and not _run_exists(MlflowClient(uri), kept):
        kept = None  # another MLflow store than last time
    opened = MLflowLogger(experiment, run_name=study.study_name, tracking_uri=uri, run_id=kept, root=logger["root"])
    client, run = opened.client, str(opened.run_id)
    client.update_run(run, status="RUNNING")
    if kept is None:
        study.set_user_attr(RUN, run)
        tags = {
            "verb": "sweep",
            "architecture": plan.system,
            "scene": plan.scene,
            "sweep.study": study.study_name,
            "sweep.sampler": plan.sampler["name"],
            "sweep.objectives": ", ".join(objective.metric for objective in plan.objectives),
        }
        for name, value in tags.items():
            client.set_tag(run, name, value)
        client.log_artifact(run, str(plan.file))
        for base in plan.bases.values():
            client.log_artifact(run, str(base))
    return client, run


def describe_parent(client: MlflowClient, run: str, study: Study, plan: Plan) -> None:
    """Make a table of the best trials the description of the study's run."""
    rows = []
    for trial in best_trials(study, plan)[:SHOWN]:
        # In one column, which wraps: a wide table pushes the rest off MLflow's page.
        settings = ", ".join(f"{key.partition('.')[2]} {format_value(value)}" for key, value in trial.params.items())
        rows.append([str(trial.number), *map(format_value, trial.values), settings])
    table = format_markdown(["trial", *(objective.metric for objective in plan.objectives), "settings"], rows)
    client.set_tag(run, "mlflow.note.content", f"{count_states(study)}\n\n{table}")


def close_parent(client: MlflowClient, run: str, study: Study, status: str) -> None:
    """End the study's run, unless another command runs a trial; that command ends it then."""
    if not study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)) and _run_exists(client, run):
        client.set_terminated(run, status)


def close_run(client: MlflowClient, run: str | None, reason: str) -> None:
    """Mark the run of a trial whose process is gone; nothing is done where it has no run yet."""
    if run is not None and _run_exists(client, run):
        client.set_tag(run, "sweep.state", "FAILED")
        client.set_tag(run, "sweep.reason", reason)
        client.set_terminated(run, "KILLED")


def _run_exists(client: MlflowClient, run: str) -> bool:
    try:
        return client.get_run(run).info.lifecycle_stage == "active"
    except MlflowException:
        return False
