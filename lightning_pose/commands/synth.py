"""The command `synth`: renders a synthetic room as a dataset, for users who have no data yet."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lightning_pose.commands.parser import VerbParser
from lightning_pose.scenes.synthetic import render_room

__all__ = ["main"]

DESCRIPTION = """Render a furnished room along hand-held camera paths, with exact poses.

DIR becomes a dataset in 7-Scenes layout: seq-01, seq-02, ... with frame-000000.color.png and
frame-000000.pose.txt (4x4 camera-to-world, OpenCV axes, metres, z up), TrainSplit.txt, TestSplit.txt, and
synthetic.json with the camera's intrinsics. Every seed is another room; the same values give the same bytes.

With --sessions N, seq-01 to seq-N are visits of one room at other times: independent walks, other light, exposure and
blur, some furniture moved and some boxes gone. The last one is the test split. Errors of a system that was trained on
some visits and tested on another are synthetic, as the room is."""

EPILOG = """examples:
  python -m lightning_pose synth rooms/0
  python -m lightning_pose synth rooms/1 --seed 1 --frames 1000 --size 640x480
  python -m lightning_pose synth rooms/visits --sessions 3 --frames 900
  python -m lightning_pose fit --config configs/landmark_map.yaml --data.root rooms/visits \\
      --data.split folders:seq-02"""


def main(argv: list[str]) -> int:
    """Run the command with the arguments after its name; return the exit code."""
    args = _build_synth_parser().parse_args(argv)
    columns = (TextColumn("rendering"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, transient=True) as bar:
        task = bar.add_task("rendering", total=args.frames)

        def show(done: int, total: int) -> None:
            bar.update(task, completed=done)

        render_room(args.dir, args.seed, args.frames, args.size, show, args.sessions)
    visits = "" if args.sessions == 1 else f" in {args.sessions} sessions"
    print(f"{args.dir} holds room {args.seed}: {args.frames} frames of {args.size[0]}x{args.size[1]} pixels{visits}")
    print(f"next: python -m lightning_pose fit --config configs/quickstart.yaml --data.root {args.dir}")
    return 0


def _build_synth_parser() -> VerbParser:
    parser = VerbParser(
        "synth",
        description=DESCRIPTION,
        epilog=EPILOG,
    )
    parser.add_argument("dir", metavar="DIR", type=Path, help="folder to write; its parents are made")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="which room (default: 0)")
    parser.add_argument("--frames", metavar="M", type=int, default=300, help="images over all sequences (default: 300)")
    parser.add_argument("--sessions", metavar="N", type=int, default=1, help="visits at other times (default: 1)")
    parser.add_argument("--size", metavar="WxH", type=_parse_size, default=(320, 240), help="default: 320x240")
    return parser


def _parse_size(text: str) -> tuple[int, int]:
    """Width and height from a text WxH, in pixels."""
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size; give WxH in pixels, like 320x240") from None
    return width, height
