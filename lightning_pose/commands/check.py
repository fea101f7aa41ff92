"""The command `check`: shows what a dataset holds and what is wrong with it, before anything is trained on it."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.progress import track
from rich.table import Table

from lightning_pose.commands.parser import VerbParser
from lightning_pose.scenes.formats import known_formats, load_scene
from lightning_pose.scenes.inspect import (
    ImageFile,
    count_sequence_frames,
    describe_scene,
    inspect_images,
    inspect_poses,
    read_image_files,
)
from lightning_pose.scenes.scene import SPLITS, Scene

__all__ = ["main"]


def main(argv: list[str]) -> int:
    """Run the command with the arguments after its name.

    Returns:
        0 if the dataset has no errors (there may be warnings), else 2.

    Raises:
        PoseError: the dataset cannot be read at all.
    """
    args = _build_check_parser().parse_args(argv)
    console = Console(markup=False, emoji=False)  # names of scenes are not markup
    scene = load_scene(args.dir, args.format)
    reading = track(read_image_files(scene), "reading images", len(scene.frames), console=console, transient=True)
    files = list(reading)
    console.print(_make_overview(scene, files))
    console.print(_make_sequence_table(scene))
    in_images, in_poses = inspect_images(scene, files), inspect_poses(scene)
    errors, warnings = in_images.errors + in_poses.errors, in_images.warnings + in_poses.warnings
    for kind, texts in (("error", errors), ("warning", warnings)):
        for text in texts:
            console.print(f"{kind}: {text}", markup=False, highlight=False, soft_wrap=True)
    if not errors:
        console.print(f"{args.dir} is usable as it is", markup=False, highlight=False, soft_wrap=True)
    return 2 if errors else 0


def _make_overview(scene: Scene, files: list[ImageFile]) -> Table:
    table = Table(title=f"{scene.name}: {len(scene.frames)} frames", show_header=False, title_justify="left")
    for name, value in describe_scene(scene, files).items():
        table.add_row(name, value)
    return table


def _make_sequence_table(scene: Scene) -> Table:
    table = Table("sequence")
    for name in (*SPLITS, "first", "last"):
        table.add_column(name, justify="right")
    for sequence in count_sequence_frames(scene):
        numbers = (*sequence.counts.values(), sequence.first, sequence.last)
        table.add_row(sequence.name, *map(str, numbers))
    return table


def _build_check_parser() -> VerbParser:
    parser = VerbParser(
        "check",
        description="Show what a dataset holds and what is wrong with it. Exit code 0: it is usable; 2: it is not.",
    )
    parser.add_argument("dir", metavar="DIR", type=Path, help="the scene's folder")
    formats = ", ".join(sorted(known_formats()))
    parser.add_argument("--format", metavar="F", help=f"{formats} (default: recognised from the files)")
    return parser
