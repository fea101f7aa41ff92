"""Landmark maps of other keypoints: accuracy, size and seconds for each extractor and number of features.

    python benchmarks/map_extractors.py --root DIR [--pgt DIR] [--only SURF:300 SIFT:300 ...]

Each row is a fit as of configs/landmark_map.yaml. On the kitchen cut one takes from 20 CPU seconds (SURF, 100) to 6
minutes (SURF, 1000); features that the cache lacks take longer.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import tempfile
from pathlib import Path

from map_trials import add_scene_arguments, find_truths, fit_map, load_scene, print_table

from lightning_pose.features import AKAZE, ORB, SIFT, SURF, LocalExtractor

EXTRACTORS: dict[str, type[LocalExtractor]] = {"SURF": SURF, "SIFT": SIFT, "ORB": ORB, "AKAZE": AKAZE}
DEFAULT = ["SURF:100", "SURF:200", "SURF:300", "SURF:500", "SURF:1000", "SIFT:300", "ORB:300", "AKAZE:300"]


def measure_extractor(name: str, root: str, truth: str, pgt: str | None) -> list[object]:
    """A row of the table."""
    kind, count = name.split(":")
    data = load_scene(root, truth, pgt, EXTRACTORS[kind](int(count), with_geometry=True))
    with contextlib.redirect_stdout(io.StringIO()):
        fitted = fit_map(data)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "map.ckpt"
        fitted.module.trainer.save_checkpoint(file)
        size = file.stat().st_size
    errors = fitted.measure(fitted.locate())
    return [
        f"{kind}, {count}", truth, errors.medians, errors.within_5cm, f"{errors.accepted.mean():.0%}",
        "on" if fitted.adjusted else "off", len(fitted.module.network.point_map), f"{size / 1e6:.2f}",
        f"{fitted.cpu_s:.0f}",
    ]  # fmt: skip


def main() -> None:
    """Print the table, as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_arguments(parser)
    parser.add_argument("--only", nargs="+", default=DEFAULT, metavar="NAME:COUNT", help=f"of {', '.join(EXTRACTORS)}")
    args = parser.parse_args()
    truths = find_truths(args)
    rows = []
    for name in args.only:
        for truth in truths:
            rows.append(measure_extractor(name, args.root, truth, args.pgt))
            print("...", *rows[-1], flush=True)
    head = [
        "keypoints", "ground truth", "m / deg", "5 cm", "accepted", "adjustment", "points", "checkpoint MB", "fit s",
    ]  # fmt: skip
    print_table(head, rows)


if __name__ == "__main__":
    main()
