"""Pose errors: `summary` of a set, `pose_metrics` over batches, `trajectory` errors of whole sequences."""
