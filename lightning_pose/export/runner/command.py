"""The command line of an exported folder: one JSON line an image."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from lightning_pose.errors import PoseError
from lightning_pose.localization.localizer import Localizer

__all__ = ["main"]


def main(folder: Path, argv: Sequence[str] | None = None) -> int:
    """Locate the images of a command line, and print each pose as a JSON line.

    Returns:
        0; 1 if an image was refused; 2 if one cannot be read, or the arguments are wrong.
    """
    parser = argparse.ArgumentParser(description="Locate images: one JSON line each, camera-to-world.")
    parser.add_argument(
        "images", metavar="IMAGE", nargs="+", help="image files; of a model of clips, one video's, in order"
    )
    parser.add_argument("--camera", help="of the images, as COLMAP writes it: PINHOLE,WIDTH,HEIGHT,FX,FY,CX,CY")
    args = parser.parse_args(argv)
    code = 0
    try:
        localizer = Localizer.load(folder)
        parts = [args.images] if localizer.system.clips is not None else [[image] for image in args.images]
    except PoseError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for part in parts:
        try:
            for pose in localizer.localize(part, camera=args.camera):
                print(json.dumps(pose.to_dict()), flush=True)
                code = max(code, 0 if pose.accepted else 1)
        except PoseError as error:
            print(f"error: {error}", file=sys.stderr)
            code = 2
    return code
