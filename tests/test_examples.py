"""The scripts of `examples/` run as a user runs them, in an empty folder with an MLflow store."""

from __future__ import annotations

import runpy

import pytest

from tests.helpers import REPOSITORY, Workplace

EXPECTED = {
    "compare_systems": ["LinearPoseNet", "KernelPoseNet", "retrieval"],
    "locate_images": ["frame-000000.color.png: true [", "frame-000002.color.png: true ["],
}


def test_every_example_is_listed() -> None:
    assert {path.stem for path in (REPOSITORY / "examples").glob("*.py")} == set(EXPECTED)


@pytest.mark.parametrize("name", EXPECTED)
def test_example_prints_what_it_promises(
    name: str, workplace: Workplace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = REPOSITORY / "examples" / f"{name}.py"
    assert len(script.read_text().splitlines()) < 40
    monkeypatch.chdir(workplace.folder)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", workplace.uri)
    runpy.run_path(str(script), run_name="__main__")
    printed = capsys.readouterr().out
    for text in EXPECTED[name]:
        assert text in printed
