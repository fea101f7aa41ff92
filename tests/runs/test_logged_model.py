"""The model that a run logs: what MLflow installs for it."""

from __future__ import annotations

import ast
import sys
from importlib.util import find_spec
from pathlib import Path

from lightning_pose.runs.logged_model import REQUIREMENTS

DISTRIBUTIONS = {"PIL": "pillow", "cv2": "opencv-contrib-python-headless", "yaml": "PyYAML", "sklearn": "scikit-learn"}
"""Where a distribution's name is not that of its package."""

LIGHTNING_BRINGS = {"torchmetrics"}
MLFLOW_BRINGS = {"mlflow", "pandas"}


def test_a_logged_model_names_all_that_it_imports() -> None:
    """Follow the imports of what a localizer needs, and compare with the requirements that MLflow installs."""
    todo, seen, needed = (
        ["lightning_pose.localization.mlflow_model", "lightning_pose.models", "lightning_pose.features"],
        set(),
        set(),
    )
    while todo:
        module = todo.pop()
        spec = find_spec(module)
        if module in seen or spec is None or spec.origin is None:
            continue
        seen.add(module)
        for name in _imported(Path(spec.origin)):
            (todo.append if name.startswith("lightning_pose") else needed.add)(name)
    packages = {name.partition(".")[0] for name in needed} - set(sys.stdlib_module_names)
    distributions = {DISTRIBUTIONS.get(package, package) for package in packages}
    assert distributions - LIGHTNING_BRINGS - MLFLOW_BRINGS <= set(REQUIREMENTS)


def _imported(file: Path) -> set[str]:
    """Modules that a file imports when it is imported itself."""
    names: set[str] = set()
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names
