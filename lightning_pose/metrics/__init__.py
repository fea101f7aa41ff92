"""Pose errors: `catalog` has all names, `summary` one set, `pose_metrics` batches, `trajectory` whole sequences."""
