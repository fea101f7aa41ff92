"""Checksums of an exported folder: of each file that is read, in `localizer.json`, and of `localizer.json` itself."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning_pose.errors import CheckpointError

__all__ = ["check_facts", "check_part", "hash_part", "sign_facts"]


def sign_facts(facts: Mapping[str, Any]) -> dict[str, Any]:
    """The facts with their own checksum, `sha256`."""
    unsigned = {name: value for name, value in facts.items() if name != "sha256"}
    text = json.dumps(unsigned, sort_keys=True)
    return unsigned | {"sha256": hashlib.sha256(text.encode()).hexdigest()}


def check_facts(facts: Mapping[str, Any], path: Path) -> None:
    """Compare what `localizer.json` says with its checksum; a folder of an earlier version has none.

    Raises:
        CheckpointError: they differ.
    """
    # One damaged byte can hide one of the two names, and not both.
    if not {"sha256", "files"} & facts.keys():
        return
    if facts != sign_facts(facts):
        raise CheckpointError(f"{path} is damaged (its checksum differs); copy it again, or export the model again")


def hash_part(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal digits; ends of lines in a Python file may be those of any system.

    Raises:
        CheckpointError: it cannot be read.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read ({error.strerror}); export the model again") from error
    if path.suffix == ".py":
        data = data.replace(b"\r\n", b"\n")
    return hashlib.sha256(data).hexdigest()


def check_part(folder: Path, facts: Mapping[str, Any], name: str) -> Path:
    """A file of the folder, whose content must have the checksum that `localizer.json` gives.

    Raises:
        CheckpointError: it is missing or damaged, or is not directly in the folder.
    """
    if Path(name).name != name:
        raise CheckpointError(
            f"{folder}/localizer.json names a file outside the folder: {name}; export the model again"
        )
    path, files = folder / name, facts.get("files", {})
    if "files" in facts and files.get(name) != hash_part(path):
        raise CheckpointError(f"{path} is damaged (its checksum differs); copy it again, or export the model again")
    return path
