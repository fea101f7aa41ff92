"""The README's picture of MLflow's Compare page, taken in a headless Chromium from a store of one's own.

    python -m docs.screenshot docs/mlflow_compare.png "LinearPoseNet redkitchen D=1280" "SurfLSTM redkitchen N=50" ...

Run it from the repository; the names are those of runs in the `mlruns/mlflow.db` of `--folder DIR`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tests import browser

PARAMS = ["architecture"]
METRICS = ["cost/parameters", "cost/train_seconds", "test/orientation_median_deg", "test/position_median_m"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", type=Path)
    parser.add_argument("runs", nargs="+", metavar="RUN")
    parser.add_argument("--folder", type=Path, default=Path())
    args = parser.parse_args()
    with browser.mlflow_ui(args.folder) as ui, browser.open_page(ui.address(), width=1280, height=840) as page:
        browser.open_runs(page, ui.address())
        page.get_by_role("button", name="Close").click()  # MLflow's assistant
        compared = browser.compare(page, args.runs)
        page.get_by_role("button", name="Toggle sidebar").click()
        compared.parallel_coordinates(PARAMS, METRICS)
        page.mouse.move(0, 0)
        page.wait_for_timeout(1000)  # the plot fills the width that the sidebar leaves
        page.screenshot(path=args.picture)
    print(args.picture)


if __name__ == "__main__":
    main()
