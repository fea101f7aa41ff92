"""Test frames that the user chooses: in blocks, every k-th frame, by folder, or by a file that lists images."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

import numpy as np

from lightning_pose.errors import ConfigError, DataError
from lightning_pose.scenes.formats.text_files import read_lines
from lightning_pose.scenes.scene import SPLITS, Scene

__all__ = ["apply_split_rule", "check_split_rule"]

FORMS = "blocks; every_K, such as every_5; folders:NAME,NAME; or a text file with `IMAGE train|val|test` in each line"
"""What a rule may be, for messages."""


def check_split_rule(rule: str) -> str:
    """The kind of a rule: `blocks`, `every`, `folders` or `file`.

    Raises:
        ConfigError: it is none of these, or its file is missing.
    """
    if rule == "blocks":
        return rule
    if re.fullmatch(r"every_[0-9]+", rule):
        if int(rule[6:]) < 2:
            raise ConfigError(f"data.split is {rule}; give every_2 or more, so that frames are left to train on")
        return "every"
    if rule.startswith("folders:") and rule[8:].strip(","):
        return "folders"
    if Path(rule).expanduser().is_file():
        return "file"
    raise ConfigError(f"data.split is {rule!r}, which is no file and no rule; give {FORMS}")


def apply_split_rule(scene: Scene, rule: str) -> dict[str, np.ndarray]:
    """Frame indices of `train` and `test` by a rule, and of `val` if the rule names validation frames.

    Args:
        scene: its own splits are not read.
        rule: `blocks` gives no indices; `every_K` tests on the first and then on every K-th frame of each sequence;
            `folders:NAME,NAME` on the sequences of these names; otherwise the path of a text file with the name of an
            image and its split in each line, in any order. An image that the file does not list is not used.

    Raises:
        ConfigError: the rule is of no such form, or names a sequence that is not there.
        DataError: a line of the file has another form, or names no image of the scene, or a split has no frame.
    """
    kind = check_split_rule(rule)
    if kind == "blocks":
        return {}
    sequences = np.array([frame.sequence for frame in scene.frames])
    everything = np.arange(len(scene.frames))
    if kind == "file":
        splits = _read_split_file(scene, Path(rule).expanduser())
    elif kind == "every":
        starts = np.array([int(np.argmax(sequences == name)) for name in sequences])
        tested = (everything - starts) % int(rule[6:]) == 0
        splits = {"train": everything[~tested], "test": everything[tested]}
    else:
        tested = np.isin(sequences, _find_sequences(scene, rule[8:].split(",")))
        splits = {"train": everything[~tested], "test": everything[tested]}
    for split in ("train", "test"):
        if not len(splits[split]):
            raise DataError(f"data.split is {rule}, which leaves no {split} frame of {scene.root}; give another rule")
    return splits


def _find_sequences(scene: Scene, wanted: list[str]) -> list[str]:
    """The sequences of these names, or whose last folder has the name."""
    known = list(dict.fromkeys(frame.sequence for frame in scene.frames))
    found = []
    for name in (part.strip() for part in wanted if part.strip()):
        matching = [sequence for sequence in known if name in (sequence, PurePosixPath(sequence).name)]
        if not matching:
            raise ConfigError(f"data.split names the folder {name!r}; {scene.root} has {', '.join(known[:20])}")
        found += matching
    return found


def _read_split_file(scene: Scene, path: Path) -> dict[str, np.ndarray]:
    """Frame indices by the splits of a file; `val` only if the file has it."""
    index: dict[str, list[int]] = {}
    for i, frame in enumerate(scene.frames):
        parts = frame.image.parts
        for length in range(1, min(len(parts), 6) + 1):
            index.setdefault("/".join(parts[-length:]), []).append(i)
    split_of: dict[int, str] = {}
    for number, line in read_lines(path):
        name, _, split = line.replace("\\", "/").rpartition(" ")
        name = name.strip().strip(",;").removeprefix("./")
        if split not in SPLITS or not name:
            raise DataError(f"{path}:{number}: expected `IMAGE train|val|test`, found `{line[:200]}`; correct the line")
        rows = index.get(name, [])
        if len(rows) != 1:
            count = "several images" if rows else "no image"
            raise DataError(f"{path}:{number}: {name} is the name of {count} of {scene.root}; correct the line")
        split_of[rows[0]] = split
    splits = {
        split: np.array(sorted(i for i, part in split_of.items() if part == split), dtype=int) for split in SPLITS
    }
    return splits if len(splits["val"]) else {"train": splits["train"], "test": splits["test"]}
