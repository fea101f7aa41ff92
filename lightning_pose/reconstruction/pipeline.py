"""The whole way from a video or a folder to a COLMAP model; each step goes on where an earlier call has stopped."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from threadpoolctl import threadpool_limits

from lightning_pose.errors import DataError
from lightning_pose.geometry.camera import Camera
from lightning_pose.reconstruction.agreement import drop_poor_frames, measure_span
from lightning_pose.reconstruction.alignment import find_frame
from lightning_pose.reconstruction.cameras import list_cameras
from lightning_pose.reconstruction.database import open_database
from lightning_pose.reconstruction.database_steps import extract_all, match_all
from lightning_pose.reconstruction.diagnosis import PairFacts, describe_parallax, diagnose
from lightning_pose.reconstruction.find_poses import add_frames, find_poses, read_pairs
from lightning_pose.reconstruction.frame_choice import choose_frames, measure_frames
from lightning_pose.reconstruction.pairs import choose_pairs, describe_frames
from lightning_pose.reconstruction.progress import StepProgress
from lightning_pose.reconstruction.source import Source
from lightning_pose.reconstruction.workspace import Workspace

__all__ = ["PosedFrames", "reconstruct"]

MIN_POSED = 3
"""Frames with a pose below which there is no scene."""

FEW_PHOTOS = 200
"""A folder of no more images is taken for photos, each of which is used."""

SECOND_ALIKE = 20
"""How many frames that look alike a frame without a pose is matched to in the second round."""


@dataclass(frozen=True)
class PosedFrames:
    """What was found.

    Attributes:
        names: of all chosen frames, below the folder of images.
        model: pycolmap's; image number = row + 1.
        posed: rows of the frames that have a pose in it.
        reasons: what is wrong: why others have none, and whether the cameras are too close together.
    """

    names: tuple[str, ...]
    model: pycolmap.Reconstruction
    posed: tuple[int, ...]
    reasons: tuple[str, ...]

    def list_centres(self) -> dict[str, np.ndarray]:
        """Camera centres (3,) by the names of frames."""
        return {self.names[row]: self.model.image(row + 1).projection_center() for row in self.posed}


def reconstruct(
    source: Source,
    workspace: Workspace,
    every: int | None,
    camera: Camera | None,
    wanted: Sequence[str],
    progress: StepProgress,
) -> PosedFrames:
    """Find the poses of the frames of a source.

    Args:
        source: the frames.
        workspace: where everything is kept.
        every: choose the sharpest of so many frames. By default all images of a folder with up to 200 are used, and
            others are chosen by how far the image moves.
        camera: of all frames, if it is known.
        wanted: frames that must be chosen, by name or number.
        progress: shows the steps.

    Raises:
        DataError: there are too few frames, or no scene comes out of them; the message has the reasons.
    """
    names = choose_and_write(source, workspace, every, wanted, progress)
    paths = [workspace.images / name for name in names]
    model = workspace.read_model() or _find_model(paths, workspace, camera, progress)
    with open_database(workspace.database) as database:
        counts = np.array([database.count_keypoints(row) for row in range(len(names))])
        facts = [PairFacts(a, b, len(rows), kind) for a, b, rows, kind in database.list_pairs()]
    posed = () if model is None else tuple(sorted(number - 1 for number in model.reg_image_ids()))
    reasons = diagnose(names, counts, facts, posed)
    failed = model is None or len(posed) < MIN_POSED
    if model is not None and not failed:
        text, failed = describe_parallax(facts, measure_span(model))
        reasons = [text, *reasons] if text else reasons
    if model is None or failed:
        raise DataError(f"no poses were found for the {len(names)} frames of {source.path}: {'; '.join(reasons)}")
    return PosedFrames(tuple(names), model, posed, tuple(reasons))


def choose_and_write(
    source: Source, workspace: Workspace, every: int | None, wanted: Sequence[str], progress: StepProgress
) -> list[str]:
    """Choose frames, unless an earlier call has, and write them; their names.

    Raises:
        DataError: fewer than three frames differ.
        ImageError: an image cannot be read.
    """
    kept = workspace.read("frames")
    if kept is None:
        measures = measure_frames(progress.track(source.read_gray(), "choosing frames", source.count or None))
        count = len(measures.motion)
        every = 1 if every is None and not source.is_video and count <= FEW_PHOTOS else every
        kept = {"chosen": choose_frames(measures, every).tolist(), "count": count}
    names = source.list_names(kept["count"])
    rows = {row for row in (find_frame(name, names) for name in wanted) if row is not None}
    if not rows <= set(kept["chosen"]):
        workspace.clear_results()  # of fewer frames
        kept["chosen"] = sorted(rows.union(kept["chosen"]))
    workspace.keep("frames", kept)
    chosen = kept["chosen"]
    print(f"{len(chosen)} of {kept['count']} frames of {source.path} are used", flush=True)
    if len(chosen) < MIN_POSED:
        raise DataError(
            f"{source.path} has {len(chosen)} frames that differ; give {MIN_POSED} or more, with the camera moving"
        )
    return list(progress.track(source.write(chosen, workspace.images), "writing frames", len(chosen)))


def _find_model(
    paths: Sequence[Path], workspace: Workspace, camera: Camera | None, progress: StepProgress
) -> pycolmap.Reconstruction | None:
    """Match the images and find their poses; the model is kept. None if there is none."""
    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    fixed = camera is not None
    with open_database(workspace.database) as database, threadpool_limits(1):
        database.add_images(
            [path.relative_to(workspace.images).as_posix() for path in paths], *list_cameras(paths, camera)
        )
        extract_all(database, paths, threads, progress)
        with progress.wait("finding frames that look alike"):
            vectors = describe_frames([database.read_features(row)[1] for row in range(len(paths))])
        match_all(database, choose_pairs(vectors), threads, "matching pairs", progress)
    model = find_poses(workspace, len(paths), threads, fixed, progress)
    if model is None:
        return None
    drop_poor_frames(model, read_pairs(workspace.database))
    left = set(range(len(paths))) - {number - 1 for number in model.reg_image_ids()}
    if left:
        with open_database(workspace.database) as database, threadpool_limits(1):
            again = [pair for pair in choose_pairs(vectors, SECOND_ALIKE) if set(pair) & left]
            match_all(database, again, threads, "matching frames without a pose", progress)
        model = add_frames(workspace, model, threads, fixed, progress)
        drop_poor_frames(model, read_pairs(workspace.database))
    workspace.keep_model(model)
    return model
