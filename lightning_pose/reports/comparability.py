"""What makes errors comparable: one column of a table has one split, one ground truth, one task, one unit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from lightning_pose.errors import ConfigError
from lightning_pose.runs.reader import Run

__all__ = [
    "FACTS",
    "FOLDERS",
    "column_facts",
    "describe_facts",
    "differing_settings",
    "missing_facts",
    "same_data",
    "tested",
]

FACTS = (
    "task",
    "dataset",
    "split",
    "ground_truth",
    "unit",
    "image_size",
    "test_frames",
    "clip_length",
    "stride",
    "relative_frame",
)
"""Tags that all runs of a scene must share; the last three are told by models of clips alone."""

OF_CLIPS = FACTS[7:]
REASONS = {
    "task": "an error within a clip is relative to its first frame, that of a single image is absolute",
    "clip_length": "errors relative to a clip's first frame grow with the clip",
    "stride": "errors relative to a clip's first frame grow with the stride",
    "relative_frame": "relative positions have other axes",
}

OPERATIONAL = {"data.cache_dir", "data.workers"}
"""Settings that no result depends on."""

FOLDERS = ("data.root", "data.train_scenes", "data.test_scenes")
"""Settings that say where the data lie, and so name the same data in many ways."""

SEEDS = {"seed"}


def column_facts(runs: Sequence[Run]) -> dict[str, str]:
    """What the runs of one scene share.

    A run without a fact matches every value: older runs lack some.

    Raises:
        ConfigError: two runs differ in a fact, so that their errors do not compare.
    """
    facts = {}
    for fact in FACTS:
        told = {run.settings[fact]: run for run in reversed(runs) if fact in run.settings}  # the newest of each
        if len(told) > 1:
            counts = Counter(run.settings[fact] for run in runs if fact in run.settings)
            (one, many), (other, few) = counts.most_common(2)
            why = REASONS.get(fact, f"errors on another {fact.replace('_', ' ')} say something else")
            raise ConfigError(
                f"runs on {runs[0].scene} differ in {fact} and cannot share a column ({why}): {told[one]} has {one} "
                f"({many} in all), {told[other]} has {other} ({few}); give --tag {fact}={one} or --tag {fact}={other}"
            )
        if told:
            facts[fact] = next(iter(told))
    return facts


def missing_facts(runs: Sequence[Run]) -> str | None:
    """A note on the facts that some runs lack; None where none does."""
    missing: dict[str, int] = {}
    for fact in FACTS:
        about = [run for run in runs if fact not in OF_CLIPS or run.settings.get("task") == "relative"]
        count = sum(fact not in run.settings for run in about)
        if count:
            missing[fact] = count
    if not missing:
        return None
    names = ", ".join(fact.replace("_", " ") for fact in missing)
    return f"{max(missing.values())} of {len(runs)} runs do not tell {names}: taken to match the others, not checked"


def describe_facts(facts: Mapping[str, str]) -> str:
    """The facts of a column in words."""
    task = facts.get("task")
    parts = []
    if task == "relative":
        length, stride = facts.get("clip_length", "?"), facts.get("stride", "1")
        every = "" if stride == "1" else f", every {stride}th"
        axes = "the first camera's" if facts.get("relative_frame") == "camera" else "the world's"
        parts.append(f"poses relative to the first of {length} frames{every}, in {axes} axes")
    elif task:
        parts.append("absolute poses")
    for fact, words in (
        ("split", "{} split"),
        ("ground_truth", "{} ground truth"),
        ("image_size", "images {}"),
        ("test_frames", "{} test frames"),
    ):
        if fact in facts:
            parts.append(words.format(facts[fact]))
    if facts.get("unit", "m") != "m":
        parts.append("positions in units of the scene, not metres")
    return ", ".join(parts) or "nothing told of split and ground truth"


def tested(scene: str, facts: Mapping[str, str], fact: str) -> str | None:
    """A fact of the scene that a column's errors are of: of `den to chess`, trained in one and tested in the other, a
    run has the ground truth `synthetic+original`."""
    told = facts.get(fact)
    if told is None or "+" in scene.rpartition(" to ")[2]:
        return told
    return told.rpartition("+")[2]


def same_data(runs: Sequence[Run]) -> bool:
    """Whether runs have the same scene, split and number of test frames, whatever folder they read them from."""
    told = {tuple(run.settings.get(fact) for fact in ("scene", "split", "test_frames")) for run in runs}
    return len(told) == 1 and None not in next(iter(told))


def differing_settings(runs: Iterable[Run], ignore: Iterable[str] = ()) -> dict[str, list[str]]:
    """Settings of the runs that differ, with their values; a run without a setting matches every value.

    Args:
        runs: two or more, or nothing differs.
        ignore: further names to leave out, beside seeds and what no result depends on.
    """
    left_out = {*SEEDS, *OPERATIONAL, *ignore}
    values: dict[str, set[str]] = {}
    for run in runs:
        for name, value in run.params.items():
            if name not in left_out:
                values.setdefault(name, set()).add(value)
    return {name: sorted(told) for name, told in sorted(values.items()) if len(told) > 1}
