"""The file that stands alone: what it has, what it may import, and what is refused."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from lightning_pose.export.one_file import join_modules
from lightning_pose.export.runner_file import write_runner

ALONE = """
import sys
class Refuse:
    def find_spec(self, name, *_):
        if name.partition(".")[0] in {blocked!r}:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Refuse())
sys.path.insert(0, {folder!r})
import localizer
print(localizer.Rotation.__doc__[:12], sorted({blocked!r} & set(sys.modules)))
"""


def test_the_runner_needs_neither_torch_nor_the_package(tmp_path: Path) -> None:
    (tmp_path / "localizer.py").write_text(write_runner(), encoding="utf-8")
    blocked = {"torch", "scipy", "PIL", "lightning", "lightning_pose", "onnxruntime", "jaxtyping"}
    code = ALONE.format(blocked=blocked, folder=str(tmp_path))
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert found.stdout == "One rotation []\n", found.stderr


def test_every_name_of_the_runner_is_defined_once() -> None:
    tree = ast.parse(write_runner())
    names = [node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    assert len(names) == len(set(names)) > 50
    assert {"Localizer", "LocatedPose", "extract_surf", "main"} <= set(names)
    assert "lightning_pose" not in {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}


def test_the_list_of_parts_names_their_lines() -> None:
    lines = write_runner().splitlines()
    listed = [line.split(maxsplit=1) for line in lines[: lines.index('"""')] if line[:6].strip().isdigit()]
    assert len(listed) > 20
    for number, title in listed:
        assert lines[int(number) - 1].startswith(f"# {title[:60]}")


def test_definitions_come_with_what_they_use_and_what_documents_them() -> None:
    text = join_modules(["lightning_pose.mapping.point_map.quantize_descriptors"], {}, "Head.", "# tail")
    assert text.startswith('"""Head."""\n\nfrom __future__ import annotations\n\nimport numpy as np\n')
    assert 'LARGEST = 127\n"""The largest element of a stored descriptor."""\n\n\ndef quantize_descriptors' in text
    assert "class PointMap" not in text
    assert text.endswith("# tail\n")
    scope: dict[str, object] = {}
    exec(text, scope)
    assert scope["LARGEST"] == 127


def test_a_package_that_is_not_there_is_named() -> None:
    with pytest.raises(
        ValueError, match=r"lightning_pose.models.parts.neighbour_graph needs torch, which an exported folder"
    ):
        join_modules(["lightning_pose.models.parts.neighbour_graph.search_neighbours"], {}, "", "")
    with pytest.raises(ValueError, match="does not define nothing"):
        join_modules(["lightning_pose.errors.nothing"], {}, "", "")
    with pytest.raises(ValueError, match="both define MIN_MATCHES; rename one"):
        join_modules(
            [f"lightning_pose.mapping.{name}.MIN_MATCHES" for name in ("frame_matches", "map_localizer")], {}, "", ""
        )
