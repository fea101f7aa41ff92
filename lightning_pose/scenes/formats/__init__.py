"""Folders on disk to a `Scene`: one module per format; `base` describes how to add one."""

from __future__ import annotations

import logging
import pkgutil
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Literal, get_args

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.scenes.formats.base import SceneFormat, describe_bad_frames
from lightning_pose.scenes.formats.split_rules import apply_split_rule
from lightning_pose.scenes.scene import Scene
from lightning_pose.scenes.splits import make_splits

__all__ = ["OnBadFrame", "SceneFormat", "known_formats", "load_scene"]

log = logging.getLogger("lightning_pose")

OnBadFrame = Literal["refuse", "drop"]
"""What happens to a dataset with frames that cannot be used: it is refused, or they are left out with a count."""


def known_formats() -> dict[str, SceneFormat]:
    """Formats by name: the `FORMAT` of each module of this package."""
    modules = (import_module(f"{__name__}.{info.name}") for info in pkgutil.iter_modules(__path__))
    formats = [module.FORMAT for module in modules if hasattr(module, "FORMAT")]
    return {format.name: format for format in formats}


def load_scene(
    root: Path | str,
    format: str | None = None,
    val_fraction: float = 0.1,
    test_fraction: float = 0.2,
    val_block: int = 1,
    on_bad_frame: OnBadFrame | Literal["list"] = "refuse",
    split: str | None = None,
) -> Scene:
    """Read a folder of posed images.

    Args:
        root: the scene's folder.
        format: name of its format; recognised from the files if it is None.
        val_fraction: part of the training frames to validate on, see `splits`; 0 for none.
        test_fraction: part of all frames to test on, if the format has no official split.
        val_block: least number of consecutive validation frames, if sequences are that long.
        on_bad_frame: what to do if frames cannot be used, because their pose is missing, has NaN, infinite or no
            numbers or is no rotation, or because their image is missing: `refuse` the scene, `drop` the frames with a
            warning, or `list` them in `bad_frames` without a warning.
        split: a rule that says which frames to test on, see `apply_split_rule`; None for the format's own split, and
            for `blocks` where it has none.

    Returns:
        the scene with splits `train`, `val` and `test`; no image is decoded.

    Raises:
        ConfigError: no format has that name, `on_bad_frame` is unknown, `split` is no rule, or a fraction is out of
            range.
        DataError: the folder is missing or of no known format, one of its files is missing or malformed, or frames
            cannot be used.
    """
    if on_bad_frame not in (*get_args(OnBadFrame), "list"):
        raise ConfigError(f"on_bad_frame is {on_bad_frame!r}; give refuse or drop")
    root = Path(root).expanduser()
    if not root.is_dir():
        raise DataError(f"{root} is not a folder; give the folder of a scene")
    scene = _choose_scene_format(root, format).read(root)
    _check_bad_frames(scene, on_bad_frame)
    source = "official" if scene.splits else "blocks"
    if split is not None:
        scene, source = replace(scene, splits=apply_split_rule(scene, split)), split
    return replace(scene, splits=make_splits(scene, val_fraction, test_fraction, val_block), split_source=source)


def _check_bad_frames(scene: Scene, on_bad_frame: str) -> None:
    """Refuse a scene with unusable frames, or log how many there are; refuse one that has no others in a split."""
    empty = [split for split, indices in scene.splits.items() if not len(indices)]
    if empty or (scene.bad_frames and not scene.frames):
        left = f"no usable frame for the {' and the '.join(empty)} split" if empty else "no usable frame"
        reason = describe_bad_frames(scene) if scene.bad_frames else "check that the download is complete"
        raise DataError(f"{scene.root} has {left}; {reason}")
    if scene.bad_frames and on_bad_frame == "refuse":
        raise DataError(
            f"{scene.root}: {describe_bad_frames(scene)}. Or leave them out with data.on_bad_frame: drop "
            '(`load_scene(..., on_bad_frame="drop")` in Python)'
        )
    if scene.bad_frames and on_bad_frame == "drop":
        log.warning("%s: left out: %s", scene.root, describe_bad_frames(scene))


def _choose_scene_format(root: Path, name: str | None) -> SceneFormat:
    """The format of that name; without a name, the only one that the folder matches."""
    formats = known_formats()
    if name is not None:
        if name not in formats:
            raise ConfigError(f"format {name!r} is unknown; the formats are {', '.join(sorted(formats))}")
        return formats[name]
    matching = _find_matching_formats(root)
    if len(matching) > 1:
        raise DataError(f"{root} may be {' or '.join(matching)}; give one of them as `format`")
    if matching:
        return formats[matching[0]]
    scenes = [child.name for child in sorted(root.iterdir()) if child.is_dir() and _find_matching_formats(child)]
    if scenes:
        raise DataError(f"{root} is no dataset itself but holds {', '.join(scenes)}; give one of these")
    looked = "; ".join(f"{format.name}: {format.looks_for}" for format in formats.values())
    raise DataError(
        f"{root} holds no dataset of a known format, looked for {looked}; "
        "give the folder that has these files, or force a format with `format`"
    )


def _find_matching_formats(root: Path) -> list[str]:
    """Names of the formats that the folder matches."""
    return [name for name, format in known_formats().items() if format.matches(root)]
