"""MLflow's UI in a headless browser, handled as a user would: rows, buttons, tabs and what they show."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page, Route

__all__ = [
    "Compared",
    "Ui",
    "chromium",
    "compare",
    "listed",
    "mlflow_ui",
    "open_figure",
    "open_page",
    "open_run",
    "open_runs",
    "unfold",
]

PATIENCE = 60  # seconds, for a server that starts and for a page of it, on a busy machine


def chromium() -> str | None:
    """A Chromium of the system, if there is one."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return next((path for name in names if (path := shutil.which(name))), None)


class Ui:
    """The README's `mlflow ui` on the default store of a folder, on a free port; it starts at once, in its own time.

    Args:
        folder: has the store in `mlruns`.
    """

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        command = [sys.executable, "-m", "mlflow", "ui", "--backend-store-uri", "sqlite:///mlruns/mlflow.db"]
        self.process = subprocess.Popen(
            [*command, "--port", str(self.port), "--workers", "1"],
            cwd=folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # its workers end with it, by their group
        )

    def address(self) -> str:
        """Where it is, once it answers.

        Raises:
            RuntimeError: it has ended, or does not answer within `PATIENCE`.
        """
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end and self.process.poll() is None:
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{self.port}/health", timeout=5).close()
                return f"http://127.0.0.1:{self.port}"
            except OSError:
                time.sleep(0.2)
        raise RuntimeError(f"mlflow ui does not answer on port {self.port}; its exit code is {self.process.poll()}")


@contextmanager
def mlflow_ui(folder: Path) -> Iterator[Ui]:
    """A `Ui` that ends with the block."""
    ui = Ui(folder)
    try:
        yield ui
    finally:
        os.killpg(ui.process.pid, signal.SIGKILL)
        ui.process.wait()


@contextmanager
def open_page(address: str, width: int = 1400, height: int = 1000) -> Iterator[Page]:
    """A fresh page of a headless Chromium that reaches `address` alone: MLflow asks servers of its own otherwise."""
    from playwright.sync_api import sync_playwright

    def only_here(route: Route) -> None:
        if route.request.url.startswith((address, "data:", "blob:")):
            route.continue_()
        else:
            route.abort()

    with sync_playwright() as playwright:
        # Chromium has no sandbox for root, as whom containers run.
        browser = playwright.chromium.launch(executable_path=chromium(), args=["--no-sandbox"])
        try:
            page = browser.new_page(viewport={"width": width, "height": height})
            page.set_default_timeout(PATIENCE * 1000)
            page.route("**/*", only_here)
            yield page
        finally:
            browser.close()


def open_runs(page: Page, address: str) -> None:
    """From the first page to the runs of the experiment, on the side of MLflow that is about training."""
    page.goto(f"{address}/#/")
    page.get_by_role("heading", name="Welcome to MLflow").wait_for()
    page.get_by_role("button", name="Model training").click()
    page.get_by_role("row").get_by_role("link", name="lightning_pose", exact=True).click()
    page.get_by_role("heading", name="Runs").wait_for()
    page.get_by_role("row").filter(has=page.get_by_role("link")).first.wait_for()


def row(page: Page, name: str) -> Locator:
    """The row of the run of this name."""
    return page.get_by_role("row").filter(has=page.get_by_role("link", name=name, exact=True))


def open_run(page: Page, name: str) -> None:
    """From the table to the page of one run."""
    row(page, name).get_by_role("link", name=name, exact=True).click()
    page.get_by_role("heading", name=name).wait_for()


def compare(page: Page, names: Sequence[str]) -> Compared:
    """Select runs in the table, by name, and press Compare."""
    for name in names:
        row(page, name).get_by_role("checkbox", name="toggle row selection").check()
    page.get_by_role("button", name="Compare", exact=True).click()
    page.get_by_role("heading", name=f"Comparing {len(names)} Runs").wait_for()
    return Compared(page)


def listed(page: Page) -> list[str]:
    """Names of the runs in the table, from the top."""
    return [link.inner_text() for link in page.get_by_role("row").get_by_role("link").all() if _is_run(link)]


def _is_run(link: Locator) -> bool:
    return "/runs/" in (link.get_attribute("href") or "")


def unfold(page: Page, name: str, nested: str) -> None:
    """Show the runs that are nested in one of the table; MLflow remembers it.

    Args:
        page: shows the table.
        name: of the outer run.
        nested: name of a run within.
    """
    row(page, name).wait_for()
    if not row(page, nested).count():
        row(page, name).get_by_role("gridcell").get_by_role("button").click()
    row(page, nested).wait_for()


def open_figure(page: Page, file: str) -> int:
    """On the page of a run, open an image of its artifacts; its width in pixels once the browser has drawn it.

    Args:
        page: shows a run.
        file: such as `figures/trajectory.png`.
    """
    page.get_by_role("tab", name="Artifacts").click()
    folder, _, name = file.partition("/")
    page.get_by_text(folder, exact=True).click()
    page.get_by_text(name, exact=True).click()
    image = page.get_by_role("img", name=file)
    image.wait_for()
    loaded = page.wait_for_function("image => image.complete && image.naturalWidth", arg=image.element_handle())
    return int(loaded.json_value())


class Compared:
    """The page that compares runs.

    Args:
        page: shows it.
    """

    def __init__(self, page: Page) -> None:
        self.page = page

    def panel(self, name: str) -> Locator:
        """What is under a tab, opened."""
        self.page.get_by_role("tab", name=name).click()
        return self.page.get_by_role("tabpanel", name=name)

    def parallel_coordinates(self, params: Sequence[str], metrics: Sequence[str]) -> dict[str, list[float]]:
        """Choose the axes of the parallel coordinates; each run's place on each axis that is drawn."""
        from playwright.sync_api import expect

        panel = self.panel("Parallel Coordinates Plot")
        self.page.get_by_role("button", name="Clear All").click()
        for box, names in zip(panel.get_by_role("combobox").all(), (params, metrics), strict=True):
            for name in names:
                box.click()
                box.fill(name)
                self.page.get_by_title(name, exact=True).click()  # Enter would take what merely begins so
                box.press("Escape")
        expect(panel.locator(".axis-title")).to_have_text([*params, *metrics], timeout=PATIENCE * 1000)
        assert self._patches(panel) > 0, "lines are drawn"
        (plot,) = self._plots(panel)
        return {axis["label"]: axis["values"] for axis in plot["dimensions"]}

    def scatter(self, x: str, y: str) -> list[tuple[float, float]]:
        """Choose the axes of the scatter plot; its points.

        Raises:
            AssertionError: not as many dots are to be seen; points may not overlap.
        """
        panel = self.panel("Scatter Plot")
        for box, name in zip(panel.get_by_role("combobox").all(), (x, y), strict=True):
            box.click()
            self.page.get_by_role("option", name=name, exact=True).click()
        for axis, name in (("x", x), ("y", y)):
            panel.locator(f".{axis}title").filter(has_text=name).wait_for()
        (plot,) = self._plots(panel)
        assert self._patches(panel, wanted=len(plot["x"])) == len(plot["x"])
        return list(zip(plot["x"], plot["y"], strict=True))

    def differing_parameters(self) -> list[str]:
        """Names of the parameters that differ, as the page tells them where asked for no others."""
        switch = self.page.get_by_role("switch", name="Parameters - Show diff only")
        switch.click()
        names = switch.locator("xpath=ancestor::*[.//table][1]").get_by_role("rowheader")
        names.first.wait_for()
        return names.all_inner_texts()

    def _plots(self, panel: Locator) -> list[dict[str, Any]]:
        return panel.locator(".js-plotly-plot").evaluate("plot => plot.data")

    def _patches(self, panel: Locator, wanted: int | None = None) -> int:
        """Patches of colour in the plot, as seen: plotly draws on a canvas, and takes its time."""
        count = 0
        for _ in range(20):
            picture = np.frombuffer(panel.locator(".js-plotly-plot").screenshot(), np.uint8)
            pixels = np.asarray(cv2.imdecode(picture, cv2.IMREAD_COLOR)).astype(int)
            colored = np.ptp(pixels, axis=-1) > 60  # axes and letters are gray
            count = cv2.connectedComponents(colored.astype(np.uint8))[0] - 1  # without the background
            if count == wanted or (count and wanted is None):
                break
            self.page.wait_for_timeout(250)
        return count
