"""Poses as lines of text: TUM, JSON lines, or CSV."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Literal, TextIO, get_args

from lightning_pose.localization.located_pose import LocatedPose

__all__ = ["LineFormat", "PoseWriter", "find_line_format"]

LineFormat = Literal["tum", "jsonl", "csv"]

SUFFIXES: dict[str, LineFormat] = {".jsonl": "jsonl", ".ndjson": "jsonl", ".json": "jsonl", ".csv": "csv"}

COLUMNS = (
    "image", "time_s", "status", "reason", "source", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz", "radius_m",
    "radius_deg", "inliers", "visible", "milliseconds", "notes",
)  # fmt: skip
"""Of a CSV file."""


def find_line_format(path: str | Path | None) -> LineFormat:
    """The format by a file's ending; TUM for others and for none."""
    return "tum" if path is None else SUFFIXES.get(Path(path).suffix.lower(), "tum")


class PoseWriter:
    """Writes each pose as soon as it is known.

    TUM has a comment with the image's name above each pose, and one line `# NAME refused: REASON` for a refused image,
    which has no pose there. The time of a pose is that of the video's frame, or the number in an image's name if that
    has a decimal point (TUM RGB-D), or else the image's number, counted from 0.

    Args:
        file: open for writing.
        line_format: of the lines.
    """

    def __init__(self, file: TextIO, line_format: LineFormat) -> None:
        assert line_format in get_args(LineFormat), line_format
        self._file = file
        self._count = 0
        writers: dict[LineFormat, Callable[[LocatedPose], None]] = {
            "tum": self._write_tum, "jsonl": self._write_json, "csv": self._write_csv,
        }  # fmt: skip
        self._write = writers[line_format]
        self._csv = csv.writer(file, lineterminator="\n")
        if line_format == "csv":
            self._csv.writerow(COLUMNS)
        elif line_format == "tum":
            file.write("# timestamp tx ty tz qx qy qz qw\n")

    def write(self, pose: LocatedPose) -> None:
        """Add one pose."""
        self._write(pose)
        self._count += 1
        self._file.flush()

    def _write_tum(self, pose: LocatedPose) -> None:
        name = " ".join((pose.image or f"image {self._count}").split())
        if not pose.accepted:
            self._file.write(f"# {name} refused: {pose.reason}\n")
            return
        w, x, y, z = pose.quat_wxyz
        numbers = " ".join(f"{value:.9f}" for value in (*pose.position_m, x, y, z, w))
        self._file.write(f"# {name}\n{self._find_time(pose):.6f} {numbers}\n")

    def _find_time(self, pose: LocatedPose) -> float:
        if pose.time_s is not None:
            return pose.time_s
        stem = Path(pose.image or "").stem
        return float(stem) if re.fullmatch(r"\d+\.\d+", stem) else float(self._count)

    def _write_json(self, pose: LocatedPose) -> None:
        self._file.write(json.dumps(pose.to_dict(), ensure_ascii=False) + "\n")

    def _write_csv(self, pose: LocatedPose) -> None:
        numbers = [*pose.position_m, *pose.quat_wxyz, pose.radius_m, pose.radius_deg]
        cells = [f"{value:.9g}" if math.isfinite(value) else "" for value in numbers]
        total = pose.milliseconds.get("total")
        self._csv.writerow(
            [
                pose.image,
                None if pose.time_s is None else f"{pose.time_s:.6f}",
                pose.status,
                pose.reason,
                pose.source,
                *cells,
                pose.inliers,
                pose.visible,
                None if total is None else f"{total:.3f}",
                "; ".join(pose.notes),
            ]
        )
