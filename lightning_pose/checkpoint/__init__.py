"""Checkpoint files, and the objects in them as plain specs."""

from lightning_pose.checkpoint.class_paths import RENAMED_CLASSES, resolve_class_path, resolve_class_paths
from lightning_pose.checkpoint.files import check_file, read_checkpoint
from lightning_pose.checkpoint.specs import (
    Spec,
    build_object,
    check_specs,
    class_path,
    describe_object,
    find_class_paths,
)

__all__ = [
    "RENAMED_CLASSES",
    "Spec",
    "build_object",
    "check_file",
    "check_specs",
    "class_path",
    "describe_object",
    "find_class_paths",
    "read_checkpoint",
    "resolve_class_path",
    "resolve_class_paths",
]
