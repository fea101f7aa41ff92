"""Finds the poses of matched frames: pycolmap's mappers, of whose models the one that explains most matches is kept."""

from __future__ import annotations

import shutil
from pathlib import Path

import pycolmap

from lightning_pose.reconstruction.agreement import MatchedPair, count_agreeing
from lightning_pose.reconstruction.database import open_database
from lightning_pose.reconstruction.mapper import Method, run_mapper
from lightning_pose.reconstruction.pieces import join_pieces, polish
from lightning_pose.reconstruction.progress import StepProgress
from lightning_pose.reconstruction.workspace import Workspace

__all__ = ["add_frames", "find_poses", "read_pairs"]

FEW_FRAMES = 60
"""Up to so many frames the incremental mapper is tried first: it is quick then, and seldom wrong."""

GOOD_SHARE = 0.9
"""Share of all matches that a model must explain, if no other mapper is to be tried. The global mapper's models of
video explain 98 %, and where it went wrong, with photos taken far from each other, 68 %."""


def find_poses(
    workspace: Workspace, n_frames: int, threads: int, fixed: bool, progress: StepProgress
) -> pycolmap.Reconstruction | None:
    """The best model of the frames in the database; None if there is none.

    Args:
        workspace: with a filled database.
        n_frames: how many frames it has.
        threads: how many.
        fixed: whether the cameras in the database are right.
        progress: shows the steps.
    """
    pairs = read_pairs(workspace.database)
    total = sum(len(rows) for *_, rows in pairs)
    methods: tuple[Method, Method] = ("global", "incremental") if n_frames > FEW_FRAMES else ("incremental", "global")
    best, most = None, 0
    for method in methods:
        model = _map_frames(method, workspace, pairs, threads, fixed, progress)
        explained = 0 if model is None else count_agreeing(model, pairs)
        if explained > most:
            best, most = model, explained
        if most >= GOOD_SHARE * total:
            break
    return best


def add_frames(
    workspace: Workspace, model: pycolmap.Reconstruction, threads: int, fixed: bool, progress: StepProgress
) -> pycolmap.Reconstruction:
    """The model with the frames that have no pose in it, where their matches with its points give one."""
    start, out = workspace.work / "start", workspace.work / "continued"
    for folder in (start, out):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
    model.write(start)
    with progress.wait("adding frames"):
        folders = run_mapper("incremental", workspace.database, out, threads, fixed, start)
    found = [pycolmap.Reconstruction(folder) for folder in folders]
    return max([model, *found], key=lambda each: each.num_reg_images())


def read_pairs(database: Path) -> list[MatchedPair]:
    """The verified pairs of a database."""
    with open_database(database) as opened:
        return [(a + 1, b + 1, rows) for a, b, rows, _ in opened.list_pairs()]


def _map_frames(
    method: Method, workspace: Workspace, pairs: list[MatchedPair], threads: int, fixed: bool, progress: StepProgress
) -> pycolmap.Reconstruction | None:
    """The model that a mapper makes, its pieces joined; None if there is none."""
    out, database = workspace.work / method, workspace.work / f"{method}.db"
    shutil.rmtree(out, ignore_errors=True)
    shutil.copyfile(workspace.database, database)  # the mapper changes focal lengths and geometries
    with progress.wait(f"finding poses ({method} mapper)"):
        folders = run_mapper(method, database, out, threads, fixed)
    database.unlink()
    models = [pycolmap.Reconstruction(folder) for folder in folders]
    models.sort(key=lambda model: -model.num_reg_images())
    if not models:
        return None
    count = models[0].num_reg_images()
    if len(models) > 1:
        with progress.wait("joining pieces"):
            models = join_pieces(models, pairs)
            if models[0].num_reg_images() > count:
                polish(models[0], workspace.database, out, threads, fixed)
    return models[0]
