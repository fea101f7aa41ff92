"""What the MLflow model takes and returns, for its signature."""

from __future__ import annotations

from mlflow.models import ModelSignature
from mlflow.types import ColSpec, Schema

__all__ = ["SIGNATURE"]

POSE = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")

SIGNATURE = ModelSignature(
    Schema(
        [
            ColSpec("binary", "image"),
            ColSpec("string", "camera", required=False),
            ColSpec("string", "prior", required=False),
        ]
    ),
    Schema(
        [
            *(ColSpec("double", name) for name in POSE),
            *(ColSpec("double", name, required=False) for name in ("radius_m", "radius_deg")),
            *(ColSpec("long", name, required=False) for name in ("inliers", "visible")),
            *(ColSpec("string", name) for name in ("status", "reason", "source")),
        ]
    ),
)
"""A row is an encoded image: its bytes in Python, base64 in JSON. No file is read, because a model that is served would
read any that a request names. What is unknown is None."""
