"""The command `check`: shows what a dataset holds and what is wrong with it, before anything is trained on it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import track
from rich.table import Table

from lightning_pose.commands.parser import VerbParser
from lightning_pose.scenes.formats import known_formats, load_scene
from lightning_pose.scenes.formats.base import describe_bad_frames
from lightning_pose.scenes.inspect import (
    ImageFile,
    count_sequence_frames,
    describe_scene,
    inspect_images,
    inspect_poses,
    read_image_files,
)
from lightning_pose.scenes.recording import describe_pose_camera, inspect_recording
from lightning_pose.scenes.scene import SPLITS, Scene

if TYPE_CHECKING:
    from lightning_pose.mapping.pose_check import PoseCheck

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
    scene = load_scene(args.dir, args.format, on_bad_frame="list")
    reading = track(read_image_files(scene), "reading images", len(scene.frames), console=console, transient=True)
    files = list(reading)
    with console.status("matching nearby frames"):
        compared = _compare_poses(scene)
    console.print(_make_overview(scene, files, compared.facts))
    console.print(_make_sequence_table(scene))
    in_images, in_poses = inspect_images(scene, files), inspect_poses(scene)
    errors = _describe_drop(scene) + in_images.errors + in_poses.errors + compared.errors
    warnings = in_images.warnings + in_poses.warnings + compared.warnings
    warnings += inspect_recording(scene, [file.digest for file in files])
    for kind, texts in (("error", errors), ("warning", warnings), ("note", describe_pose_camera(scene))):
        for text in texts:
            console.print(f"{kind}: {text}", markup=False, highlight=False, soft_wrap=True)
    if not errors:
        noted = "usable as it is" if not warnings else "usable; mind the warnings above"
        console.print(f"{args.dir} is {noted}", markup=False, highlight=False, soft_wrap=True)
    return 2 if errors else 0


def _compare_poses(scene: Scene) -> PoseCheck:
    from threadpoolctl import threadpool_limits  # not for `--help`

    from lightning_pose.mapping.pose_check import check_poses

    with threadpool_limits(1, user_api="blas"):  # it has a thread a core, and more would wait for each other
        return check_poses(scene)


def _describe_drop(scene: Scene) -> list[str]:
    """The frames that cannot be used, and what `on_bad_frame: drop` would leave; nothing if all can be used."""
    if not scene.bad_frames:
        return []
    left = ", ".join(f"{split} {len(scene.splits[split])}" for split in SPLITS)
    return [
        f"{describe_bad_frames(scene)}; data.on_bad_frame: drop leaves them out, "
        f"and {len(scene.frames)} frames are left ({left})"
    ]


def _make_overview(scene: Scene, files: list[ImageFile], compared: dict[str, str]) -> Table:
    table = Table(title=f"{scene.name}: {len(scene.frames)} frames", show_header=False, title_justify="left")
    for name, value in (describe_scene(scene, files) | compared).items():
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
