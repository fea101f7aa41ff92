"""MLflow's UI on the default store, in a real browser: runs are found, compared and looked at as a user would."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import yaml
from mlflow.entities import Run

from tests import browser
from tests.helpers import Workplace

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("playwright") is None, reason="playwright is not installed"),
    pytest.mark.skipif(browser.chromium() is None, reason="no chromium or google-chrome in PATH"),
]

FITTED = ["SurfLSTM wall N=6", "SurfLSTM wall N=6 gru seed=1", "SurfLSTM wall N=6 one-way"]
TRIALS = [f"SurfLSTM wall N=6 trial {number}" for number in range(2)]


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory, scene: Path, store: Path) -> Workplace:
    """A folder whose store is to be filled while the server, which takes as long, starts."""
    return Workplace.make(tmp_path_factory.mktemp("ui") / "workplace", scene, store)


@pytest.fixture(scope="module")
def address(filled: Workplace) -> Iterator[str]:
    """Of the UI on a store with three runs and a sweep of two trials."""
    with browser.mlflow_ui(filled.folder) as ui:
        for settings in ([], ["--model.cell", "gru", "--seed_everything", "1"], ["--model.bidirectional", "false"]):
            assert filled.run("fit", "--trainer.max_epochs", "1", *settings) == 0
        sweep = {"base": "tiny.yaml", "settings": {"trainer.max_epochs": 1}, "space": {"model.units": [4, 6]}}
        (filled.folder / "units.yaml").write_text(yaml.safe_dump(sweep | {"sampler": "grid"}))
        assert filled.command("sweep", filled.folder / "units.yaml") == 0
        yield ui.address()


@pytest.fixture(scope="module")
def window(address: str) -> Iterator[Page]:
    with browser.open_page(address) as window:
        yield window


@pytest.fixture
def page(window: Page, address: str) -> Page:
    """The table of runs, as one comes to it from MLflow's first page."""
    browser.open_runs(window, address)
    return window


def by_name(workplace: Workplace) -> dict[str, Run]:
    return {str(run.info.run_name): run for run in workplace.runs()}


def test_runs_are_listed_by_telling_names_and_trials_within_their_sweep(page: Page) -> None:
    assert browser.listed(page) == ["units-wall", *reversed(FITTED)]
    browser.unfold(page, "units-wall", TRIALS[0])
    assert set(browser.listed(page)) == {"units-wall", *FITTED, *TRIALS}


def test_selected_runs_are_compared(page: Page, filled: Workplace) -> None:
    compared = browser.compare(page, FITTED)
    runs = [by_name(filled)[name].data for name in FITTED]
    errors = [run.metrics["test/position_median_m"] for run in runs]
    parameters = [run.metrics["cost/parameters"] for run in runs]
    assert len(set(parameters)) == 3
    axes = compared.parallel_coordinates(["model.cell"], ["cost/parameters", "test/position_median_m"])
    assert sorted(axes["cost/parameters"]) == sorted(parameters)
    assert sorted(axes["test/position_median_m"]) == pytest.approx(sorted(errors))
    assert len(set(axes["model.cell"])) == 2, "gru, and lstm twice"
    points = compared.scatter("cost/parameters", "test/position_median_m")
    assert dict(points) == pytest.approx(dict(zip(parameters, errors, strict=True)))


def test_parameters_that_differ_are_those_that_were_set(page: Page) -> None:
    compared = browser.compare(page, FITTED)
    assert compared.differing_parameters() == ["model.bidirectional", "model.cell", "seed"]


def test_trials_are_compared_by_what_was_searched(page: Page, filled: Workplace) -> None:
    browser.unfold(page, "units-wall", TRIALS[0])
    compared = browser.compare(page, TRIALS)
    axes = compared.parallel_coordinates(["model.units"], ["val/loss"])
    losses = [by_name(filled)[name].data.metrics["val/loss"] for name in TRIALS]
    assert sorted(axes["model.units"]) == [4, 6]
    assert sorted(axes["val/loss"]) == pytest.approx(sorted(losses))


def test_a_run_s_page_has_the_result_beside_baselines_and_its_figures(page: Page, filled: Workplace) -> None:
    browser.open_run(page, FITTED[1])
    error = by_name(filled)[FITTED[1]].data.metrics["test/position_median_m"]
    page.get_by_role("row", name=f"SurfLSTM {error:.3f}").wait_for()
    page.get_by_role("row", name=re.compile("^retrieval_top1 ")).wait_for()
    assert browser.open_figure(page, "figures/trajectory.png") > 300
