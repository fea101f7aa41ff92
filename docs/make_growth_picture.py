"""The picture of growth in docs/cluster.md, drawn from the tables of that page.

    python -m docs.make_growth_picture docs/pictures

Run it from the repository after the tables have changed.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from lightning_pose.figures.style import STYLE

PAGE = Path(__file__).parent / "cluster.md"


def read_tables(text: str) -> list[tuple[list[str], list[list[str]]]]:
    """Header and rows of each table of a page."""
    tables: list[tuple[list[str], list[list[str]]]] = []
    inside = False
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []
        if cells and not inside:
            tables.append((cells, []))
        elif cells and set(line) - set("|-: "):
            tables[-1][1].append(cells)
        inside = bool(cells)
    return tables


def find_curves(first: str, value: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Counts and values of the tables whose column of counts is `first`, by the system that the column before names."""
    curves: dict[str, list[tuple[float, float]]] = {}
    for head, rows in read_tables(PAGE.read_text()):
        if first not in head or value not in head:
            continue
        count, wanted = head.index(first), head.index(value)
        for row in rows:
            number = row[wanted].replace(",", "")
            if number.replace(".", "").isdigit() and float(number) > 0:
                name = row[0] if count else ""
                curves.setdefault(name, []).append((float(row[count].replace(",", "")), float(number)))
    return {name: (np.array(points)[:, 0], np.array(points)[:, 1]) for name, points in curves.items()}


def draw_curve(axes: Axes, name: str, curve: tuple[np.ndarray, np.ndarray]) -> None:
    """One line, with the exponent of growth in its label."""
    exponent = np.polyfit(np.log(curve[0]), np.log(curve[1]), 1)[0]
    axes.plot(*curve, "o-", label=f"{name}: {exponent:.2f}")


def draw() -> Figure:
    """Seconds of training, and milliseconds of a query, over the number of frames."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    training, asking = figure.subplots(1, 2, width_ratios=(3, 2))
    (build,) = find_curves("frames", "build s").values()
    (query,) = find_curves("frames", "query ms").values()
    (epoch,) = find_curves("images", "an epoch's steps s").values()
    draw_curve(training, "landmark map, build", build)
    draw_curve(training, "NodePose, an epoch", epoch)
    for name, curve in find_curves("frames", "fit s").items():
        draw_curve(training, f"{name}, an epoch", curve)
    draw_curve(asking, "landmark map, query", query)
    for axes, title, unit in ((training, "Training", "CPU seconds"), (asking, "One image", "CPU milliseconds")):
        axes.set(xscale="log", yscale="log", xlabel="frames", ylabel=unit, title=title)
        axes.legend(title="exponent of growth", fontsize="small")
    asking.set_ylim(1, 100)
    return figure


def main() -> None:
    """Write growth.webp into a folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    args = parser.parse_args()
    with matplotlib.rc_context(STYLE):
        buffer = io.BytesIO()
        draw().savefig(buffer, dpi=130)
    Image.open(buffer).convert("RGB").save(args.folder / "growth.webp", quality=85)
    print(args.folder / "growth.webp")


if __name__ == "__main__":
    main()
