"""The verb `check`: what a dataset holds, and what is wrong with it, before anything is trained on it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from lightning_pose.commands.parser import VerbParser
from lightning_pose.scenes.formats import known_formats, load_scene
from lightning_pose.scenes.inspect import (
    ImageFile,
    find_angle_deg,
    format_counts,
    inspect_images,
    inspect_poses,
    map_frames_to_splits,
    measure_steps,
    read_image_file,
    stack_positions,
    stack_quats,
)
from lightning_pose.scenes.scene import SPLITS, Scene

__all__ = ["main"]


def main(argv: list[str]) -> int:
    """Run the verb with the arguments after its name.

    Returns:
        0 if nothing is wrong with the dataset (there may be warnings), else 2.

    Raises:
        PoseError: the dataset cannot be read at all.
    """
    args = _build_check_parser().parse_args(argv)
    console = Console()
    scene = load_scene(args.dir, args.format)
    files = _read_files(scene, console)
    console.print(_overview(scene, files))
    console.print(_sequences(scene))
    in_images, in_poses = inspect_images(scene, files), inspect_poses(scene)
    errors, warnings = in_images.errors + in_poses.errors, in_images.warnings + in_poses.warnings
    for kind, texts in (("error", errors), ("warning", warnings)):
        for text in texts:
            console.print(f"{kind}: {text}", markup=False, highlight=False, soft_wrap=True)
    if not errors:
        console.print(f"{args.dir} is usable as it is", markup=False, highlight=False, soft_wrap=True)
    return 2 if errors else 0


def _read_files(scene: Scene, console: Console) -> list[ImageFile]:
    images = [frame.image for frame in scene.frames]
    with ThreadPoolExecutor() as pool:  # OpenCV and hashlib let other threads run meanwhile
        files = pool.map(read_image_file, images)
        return list(track(files, "reading images", total=len(images), console=console, transient=True))


def _overview(scene: Scene, files: list[ImageFile]) -> Table:
    table = Table(title=f"{scene.name}: {len(scene.frames)} frames", show_header=False, title_justify="left")
    for name, value in _facts(scene, files):
        table.add_row(name, value)
    return table


def _facts(scene: Scene, files: list[ImageFile]) -> Iterator[tuple[str, str]]:
    """Name and value of every row of the overview."""
    yield "format", f"{scene.format}, ground truth {scene.ground_truth}"
    sizes = {split: len(scene.splits[split]) for split in SPLITS}
    yield f"split ({scene.split_source})", ", ".join(f"{split} {size}" for split, size in sizes.items())
    yield "image size", format_counts(Counter(file.size for file in files if file.size)) or "none can be read"
    camera = scene.frames[0].intrinsics
    yield "intrinsics", "unknown" if camera is None else f"f {camera.fx:g} {camera.fy:g}, c {camera.cx:g} {camera.cy:g}"
    positions = stack_positions(scene)
    yield "extent", " x ".join(f"{side:.2f}" for side in np.ptp(positions, axis=0)) + f" {scene.unit}"
    step, angle_deg, _ = measure_steps(scene)
    if len(step):
        yield "frame spacing", f"median {np.median(step):.3g} {scene.unit}, {np.median(angle_deg):.3g} deg"
    quats = stack_quats(scene)
    from_mean = find_angle_deg(Rotation.from_quat(quats, scalar_first=True).mean().as_quat(scalar_first=True), quats)
    yield "rotation", f"up to {from_mean.max():.0f} deg from the mean, median {np.median(from_mean):.0f} deg"
    train, test = scene.splits["train"], scene.splits["test"]
    if len(train) and len(test):
        distance, nearest = KDTree(positions[train]).query(positions[test])
        angle = find_angle_deg(quats[test], quats[train[nearest]])
        yield (
            "test to nearest training pose",
            f"median {np.median(distance):.3g} {scene.unit}, {np.median(angle):.3g} deg; "
            f"up to {distance.max():.3g} {scene.unit}",
        )


def _sequences(scene: Scene) -> Table:
    table = Table("sequence")
    for name in (*SPLITS, "first", "last"):
        table.add_column(name, justify="right")
    split_of = map_frames_to_splits(scene)
    for sequence in dict.fromkeys(frame.sequence for frame in scene.frames):
        rows = [i for i, frame in enumerate(scene.frames) if frame.sequence == sequence]
        counts = Counter(split_of[i] for i in rows)
        ends = (scene.frames[rows[0]].index, scene.frames[rows[-1]].index)
        table.add_row(sequence, *(str(counts[split]) for split in SPLITS), *map(str, ends))
    return table


def _build_check_parser() -> VerbParser:
    parser = VerbParser(
        "check",
        description="Say what a dataset holds and what is wrong with it. Exit code 0: usable; 2: it is not.",
    )
    parser.add_argument("dir", metavar="DIR", type=Path, help="the scene's folder")
    formats = ", ".join(sorted(known_formats()))
    parser.add_argument("--format", metavar="F", help=f"{formats} (default: recognised from the files)")
    return parser
