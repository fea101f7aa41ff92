"""A trained system in use: `localizer`, long `sequences`, and the `mlflow_model`."""
