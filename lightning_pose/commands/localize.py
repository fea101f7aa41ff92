"""The command `localize`: images, folders, videos or a camera in, one line with a pose each out."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, TextIO, get_args

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lightning_pose.commands.parser import VerbParser
from lightning_pose.concurrency.tasks import SCHEDULER_HELP
from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.localization.pose_lines import LineFormat, PoseWriter, find_line_format
from lightning_pose.localization.sources import ImageFiles, VideoSource, find_sources

if TYPE_CHECKING:
    from argparse import Namespace

    from lightning_pose.geometry.camera import Camera
    from lightning_pose.localization.localizer import Localizer
    from lightning_pose.localization.located_pose import LocatedPose

__all__ = ["main"]

DESCRIPTION = """Locate images with a trained system.

MODEL is a checkpoint that fit wrote, an MLflow run id, a model's address (models:/NAME@ALIAS, runs:/RUN_ID/model), or a
folder that export wrote. INPUTS are image files, folders of images, patterns such as "shots/*.jpg", video files,
camera:0 for a camera of this computer, and - for one path a line of standard input.

Each image gives one line, as soon as it is located:
  tum     time x y z qx qy qz qw, with the image's name in a comment above, and a comment alone for a refused image. The
          time is that of the video's frame, or the number in the name of the image (1305031102.175304.png), or else the
          image's number
  jsonl   a JSON object with everything: pose, 4x4 matrix, covariance, radii of 90 %, status and reason, milliseconds
  csv     one row, with a header
Poses are camera-to-world, of the pixels as stored, in the scene's unit.

In a video (or with --sequence) a map takes each pose as the prior of the next frame; a lost frame, and where the camera
is found again, are said. An image or a video that cannot be read is refused, and the others go on."""

EPILOG = """exit codes:
  0    every image was located and accepted
  1    some images were refused
  2    an input or an option is wrong; nothing was located
  130  interrupted (143 by SIGTERM, 129 by SIGHUP); what was located until then is written

examples:
  python -m lightning_pose localize best.ckpt image.jpg
  python -m lightning_pose localize best.ckpt photos --out poses.csv
  python -m lightning_pose localize best.ckpt walk.mp4 --every 3 --out walk.tum --draw walk.png --view walk.rrd
  find . -name "*.jpg" | python -m lightning_pose localize best.ckpt - --format jsonl"""


def main(argv: list[str]) -> int:
    """Run the command with the arguments after its name; return the exit code."""
    args = _build_parser().parse_args(argv)
    words = [*args.inputs, *(f"camera:{index}" for index in args.camera_index)]
    if not words:
        raise ConfigError("no inputs; give images, folders, videos, camera:0, or - for paths on stdin")
    if args.every < 1:
        raise ConfigError(f"--every is {args.every}; give 1 for all frames, 2 for every second one, and so on")
    if args.workers < 1:
        raise ConfigError(f"--workers is {args.workers}; give 1 or more")
    sources = find_sources(words, sys.stdin)
    from lightning_pose.localization.localizer import Localizer

    localizer = Localizer.load(args.model, args.allow or (), args.tracking_uri)
    camera = localizer.check_camera(args.camera)
    return _locate_all(localizer, camera, sources, args)


def _build_parser() -> VerbParser:
    parser = VerbParser("localize", description=DESCRIPTION, epilog=EPILOG)
    parser.add_argument("model", metavar="MODEL", help="checkpoint, run id, model's address, or exported folder")
    parser.add_argument("inputs", metavar="INPUTS", nargs="*", help="what to locate")
    parser.add_argument("--format", choices=get_args(LineFormat), help="of the lines (default: by --out, or tum)")
    parser.add_argument("--out", metavar="FILE", type=Path, help="write the lines there, not on the terminal")
    parser.add_argument("--camera", help="of all images, in COLMAP's notation: PINHOLE,640,480,FX,FY,CX,CY")
    parser.add_argument(
        "--camera-index", metavar="N", type=int, action="append", default=[], help="a camera of this computer, from 0"
    )
    parser.add_argument("--every", metavar="N", type=int, default=1, help="locate every N-th frame of a video")
    parser.add_argument("--workers", metavar="W", type=int, default=1, help="images located at once (default: 1)")
    parser.add_argument("--scheduler", help=SCHEDULER_HELP)
    parser.add_argument("--sequence", action="store_true", help="images are frames of one video, in their order")
    parser.add_argument("--draw", metavar="FILE.png", type=Path, help="draw the trajectory over the map, from above")
    parser.add_argument("--view", metavar="FILE.rrd", type=Path, help="record for the rerun viewer (extra `view`)")
    parser.add_argument("--allow", action="append", help="class path, or package, of your own that MODEL may name")
    parser.add_argument("--tracking_uri", help="MLflow's store, for runs and models")
    return parser


@dataclass
class _Trail:
    """What is kept of every image: counts and times, and for the drawing where it was."""

    milliseconds: list[float] = field(default_factory=list)
    position_m: list[np.ndarray] = field(default_factory=list)
    down: np.ndarray = field(default_factory=lambda: np.zeros(3))
    accepted: list[bool] = field(default_factory=list)

    def add(self, pose: LocatedPose) -> None:
        self.accepted.append(pose.accepted)
        self.position_m.append(pose.position_m)
        if pose.accepted:
            self.down += pose.T_world_cam[:3, 1]
        if "total" in pose.milliseconds:
            self.milliseconds.append(pose.milliseconds["total"])

    def summarize(self, out: Path | None) -> str:
        done, refused = len(self.accepted), self.accepted.count(False)
        speed = f", {np.median(self.milliseconds):.0f} ms each (median)" if self.milliseconds else ""
        return f"{done - refused} of {done} images located, {refused} refused{speed}" + (f"; {out}" if out else "")


def _locate_all(
    localizer: Localizer, camera: Camera | None, sources: list[ImageFiles | VideoSource], args: Namespace
) -> int:
    trail = _Trail()
    with ExitStack() as stack:
        file = stack.enter_context(_open_output(args.out)) if args.out else sys.stdout
        writer = PoseWriter(file, args.format or find_line_format(args.out))
        recorder = None
        if args.view:
            from lightning_pose.localization.viewer import ViewRecorder

            recorder = ViewRecorder(args.view, localizer.system.read_map_points(), camera or localizer.system.view)
            stack.callback(recorder.close)
        console = Console(stderr=True)
        bar = stack.enter_context(_make_bar(console, hidden=args.out is None and sys.stdout.isatty()))
        try:
            for pose, pixels in _locate_sources(localizer, camera, sources, args, bar):
                trail.add(pose)
                writer.write(pose)
                if recorder is not None:
                    recorder.add(pose, pixels if pixels is not None else _read_pixels(pose))
        except BrokenPipeError:  # such as `| head`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except KeyboardInterrupt:
            _finish(localizer, trail, args)
            raise KeyboardInterrupt(trail.summarize(args.out)) from None
    _finish(localizer, trail, args)
    print(trail.summarize(args.out), file=sys.stderr)
    return 0 if all(trail.accepted) else 1


def _finish(localizer: Localizer, trail: _Trail, args: Namespace) -> None:
    """Draw what was located, if that is asked for."""
    if not args.draw or not trail.accepted:
        return
    from lightning_pose.figures.maps import draw_trajectory

    position_m, accepted = np.array(trail.position_m), np.array(trail.accepted)
    points = localizer.system.read_map_points()
    args.draw.parent.mkdir(parents=True, exist_ok=True)
    draw_trajectory(points, position_m, accepted, trail.down, localizer.system.name).savefig(args.draw)


def _open_output(path: Path) -> TextIO:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("w", encoding="utf-8", newline="")
    except OSError as error:
        raise ConfigError(f"{path} cannot be written ({error.strerror}); choose another file") from error


def _make_bar(console: Console, hidden: bool) -> Progress:
    """A progress bar on standard error; lines on the same terminal would tear it."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    return Progress(*columns, console=console, transient=True, disable=hidden or not console.is_terminal)


Located = tuple["LocatedPose", "np.ndarray | None"]
"""A pose, and the image's pixels where they are at hand."""


def _locate_sources(
    localizer: Localizer, camera: Camera | None, sources: list[ImageFiles | VideoSource], args: Namespace, bar: Progress
) -> Iterator[Located]:
    """The poses of all sources, one after the other."""
    follows = args.sequence or localizer.system.clips is not None
    for source in sources:
        if isinstance(source, VideoSource):
            name, found, count = _open_video(localizer, camera, source, args.every)
        else:
            files = (
                _track_files(localizer, camera, source.paths)
                if follows
                else _locate_files(localizer, camera, source, args)
            )
            name, found, count = "images", files, source.count
        task = bar.add_task(name, total=count)
        if isinstance(source, VideoSource) or follows:
            found = _report_losses(found, bar.console)
        for item in found:
            yield item
            bar.advance(task)
        bar.update(task, visible=False)


def _open_video(
    localizer: Localizer, camera: Camera | None, source: VideoSource, every: int
) -> tuple[str, Iterator[Located], int | None]:
    """A video's name, the poses of its frames, and how many there are; a file that cannot be read is refused.

    Raises:
        ImageError: a camera cannot be opened.
    """
    from lightning_pose.localization.located_pose import refuse_image
    from lightning_pose.localization.video import VideoReader, VideoTracker

    try:
        reader, tracker = VideoReader(source.source, every), VideoTracker(localizer, camera)
    except ImageError as error:
        if isinstance(source.source, int):
            raise
        return source.source, iter([(refuse_image(source.source, str(error)), None)]), 1

    def locate_frames() -> Iterator[Located]:
        try:
            for frame in reader:
                yield replace(tracker.localize(frame.pixels, frame.time_s), image=frame.name), frame.pixels
        except ImageError as error:  # it opens, and has no frame
            yield refuse_image(reader.name, str(error)), None

    return Path(reader.name).name, locate_frames(), reader.count


def _locate_files(
    localizer: Localizer, camera: Camera | None, images: ImageFiles, args: Namespace
) -> Iterator[Located]:
    """The poses of image files, each alone; several at a time if that is asked for."""
    from lightning_pose.localization.parallel import ModelSource, locate_file, locate_files

    if args.workers == 1 and args.scheduler is None:  # one by one, as paths arrive on standard input
        found = (locate_file(localizer, camera, path) for path in images.paths)
    else:
        source = ModelSource(args.model, tuple(args.allow or ()), args.tracking_uri)
        model = localizer if args.scheduler is None else source
        found = locate_files(model, camera, images.paths, args.workers, args.scheduler)
    yield from ((pose, None) for pose in found)


def _track_files(localizer: Localizer, camera: Camera | None, paths: Iterable[str]) -> Iterator[Located]:
    """The poses of image files that are frames of one video."""
    from lightning_pose.localization.located_pose import refuse_image
    from lightning_pose.localization.video import VideoTracker

    tracker = VideoTracker(localizer, camera)
    for path in paths:
        try:
            yield tracker.localize(path), None
        except (ImageError, ConfigError) as error:
            yield refuse_image(path, str(error)), None


def _report_losses(found: Iterator[Located], console: Console) -> Iterator[Located]:
    """The same poses; a line on standard error where a camera is lost, and where it is found again."""
    lost = 0
    for pose, pixels in found:
        at = f"{pose.image}" + ("" if pose.time_s is None else f" ({pose.time_s:.2f} s)")
        if not pose.accepted:
            if not lost:
                console.print(f"lost at {at}: {pose.reason}", markup=False, highlight=False, soft_wrap=True)
            lost += 1
        elif lost:
            frames = "1 frame" if lost == 1 else f"{lost} frames"
            console.print(f"found again at {at}, after {frames}", markup=False, highlight=False, soft_wrap=True)
            lost = 0
        yield pose, pixels


def _read_pixels(pose: LocatedPose) -> np.ndarray | None:
    """The pixels of an image file, for the viewer."""
    from lightning_pose.scenes.images import decode_image, read_bytes

    if pose.image is None or not np.isfinite(pose.position_m).all():
        return None
    return decode_image(read_bytes(pose.image), pose.image, color=True)
