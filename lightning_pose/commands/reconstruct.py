"""The command `reconstruct`: images without poses become a scene that `fit` reads."""

from __future__ import annotations

import argparse
import importlib.util
import signal
import threading
import time
from pathlib import Path

from lightning_pose.commands.parser import VerbParser
from lightning_pose.errors import ConfigError
from lightning_pose.geometry.camera import Camera

__all__ = ["main"]

DESCRIPTION = """Find the poses of a video's frames, or of a folder of images, with COLMAP's mapper (pycolmap).

OUT becomes a dataset in COLMAP's format: the frames in OUT/images, the model in OUT/sparse/0, and what was found in
OUT/reconstruction.json. OUT/reconstruction has the features and matches; the same command goes on with them, and it
may be deleted afterwards.

The unit of length is arbitrary, unless a distance or a few positions are known."""

EPILOG = """examples:
  python -m lightning_pose reconstruct walk.mp4 walk
  python -m lightning_pose reconstruct photos/ hall --scale "IMG_001.jpg IMG_020.jpg 2.5"
  python -m lightning_pose reconstruct walk.mp4 walk --align known.csv      image,tx,ty,tz of three frames or more
  python -m lightning_pose fit --config configs/landmark_map.yaml --data.root walk"""

INSTALL = 'python -m pip install "lightning-camera-localization[reconstruct]"'


def main(argv: list[str]) -> int:
    """Run the command with the arguments after its name; return the exit code."""
    args = _build_parser().parse_args(argv)
    if importlib.util.find_spec("pycolmap") is None:
        raise ConfigError(f"reconstruct needs pycolmap, which is not installed; `{INSTALL}` installs it")
    from lightning_pose.reconstruction.alignment import parse_distance, read_positions
    from lightning_pose.reconstruction.pipeline import reconstruct
    from lightning_pose.reconstruction.progress import StepProgress
    from lightning_pose.reconstruction.result import make_metric, write_scene
    from lightning_pose.reconstruction.source import open_source
    from lightning_pose.reconstruction.workspace import open_workspace

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # pycolmap's own handler prints a stack of calls
    camera = None if args.camera is None else Camera.parse(args.camera)
    distance = None if args.scale is None else parse_distance(args.scale)
    known = {} if args.align is None else read_positions(args.align)
    wanted = [*known] if distance is None else [distance.first, distance.second]
    source = open_source(args.source)
    settings = {"source": source.list_facts(), "every": args.every, "camera": camera and str(camera)}
    workspace = open_workspace(args.out, settings)
    if workspace.changed:
        print(f"{args.out} is of another {' and '.join(workspace.changed)}; it is made anew")
    elif workspace.changed is not None:
        print(f"going on with what {workspace.work} has")
    start = time.monotonic()
    progress = StepProgress()
    found = reconstruct(source, workspace, args.every, camera, wanted, progress)
    summary = write_scene(workspace, found, make_metric(found, distance, known), progress.seconds)
    print("\n".join(summary.list_lines()))
    print(f"{args.out} holds the scene, after {time.monotonic() - start:.0f} s")
    print(f"next: python -m lightning_pose fit --config configs/landmark_map.yaml --data.root {args.out}")
    return 0


def _build_parser() -> VerbParser:
    parser = VerbParser("reconstruct", description=DESCRIPTION, epilog=EPILOG)
    parser.add_argument("source", metavar="VIDEO_OR_FOLDER", type=Path, help="a video file, or a folder of images")
    parser.add_argument("out", metavar="OUT", type=Path, help="folder to write")
    parser.add_argument(
        "--every",
        metavar="N",
        type=_parse_count,
        help="choose the sharpest of each N frames; 1 takes all (default: one for each 3 %% of the image's width by "
        "which the image moves; all of a folder with up to 200 images)",
    )
    parser.add_argument(
        "--camera",
        metavar="MODEL,W,H,PARAMS",
        help="the camera, in COLMAP's notation, with the first pixel's centre at 0,0; it is not changed (default: the "
        "focal length and radial distortion are found, from the EXIF data on if there are any)",
    )
    metric = parser.add_mutually_exclusive_group()
    metric.add_argument(
        "--scale", metavar='"A B METRES"', help="distance between the camera centres of the frames A and B, in metres"
    )
    metric.add_argument(
        "--align", metavar="FILE", type=Path, help="camera centres of three frames or more: a file image,tx,ty,tz"
    )
    return parser


def _parse_count(text: str) -> int:
    """A number of frames, 1 or more."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of frames; give 1 or more")
    return int(text)
