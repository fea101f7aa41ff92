"""Names of the tags of MLflow runs and the user attributes of Optuna trials that the project writes and reads."""

__all__ = ["CURVES", "DIVERGED", "METRICS", "NOTE", "OPERATIONAL", "PARENT_TAG", "PROCESS", "REASON", "RUN"]

PARENT_TAG = "mlflow.parentRunId"
"""Tag of an MLflow run: the id of the run that it is nested in."""

NOTE = "mlflow.note.content"
"""Tag that MLflow shows as a run's description, in Markdown."""

DIVERGED = "diverged"
"""Tag of a finished MLflow run whose training ended worse than it began: in what way."""

OPERATIONAL = ("cache_dir", "workers", "eval_batch_size")
"""Settings of the data that no result depends on: a run does not record them, and a report does not compare them."""

PROCESS = "process"
"""User attribute of an Optuna trial: the process that runs it."""

REASON = "reason"
"""User attribute of an Optuna trial: why it ended without a value."""

RUN = "mlflow_run"
"""User attribute of an Optuna trial, and of a study: the id of its MLflow run."""

METRICS = "metrics"
"""User attribute of an Optuna trial: everything that it measured, by metric name."""

CURVES = "curves"
"""User attribute of an Optuna trial: metrics over a whole number, such as a clip's length."""
