"""What makes errors comparable: one column of a table has one split, one ground truth, one task, one unit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from lightning_pose.errors import ConfigError
from lightning_pose.runs.reader import Run
from lightning_pose.runs.tags import OPERATIONAL

__all__ = [
    "FOLDERS",
    "column_facts",
    "describe_facts",
    "differing_settings",
    "find_tested_fact",
    "missing_facts",
    "same_data",
]

FACTS = ("task", "dataset", "split", "ground_truth", "unit", "image_size", "test_frames")
CLIP_FACTS = ("clip_length", "stride", "relative_frame")
"""Tags that all runs of a scene must share; those of clips belong to runs of task `relative` alone."""

REASONS = {
    "task": "an error within a clip is relative to its first frame, that of a single image is absolute",
    "clip_length": "errors relative to a clip's first frame grow with the clip",
    "stride": "errors relative to a clip's first frame grow with the stride",
    "relative_frame": "relative positions have other axes",
}
CAPTIONS = {
    "split": "{} split",
    "ground_truth": "{} ground truth",
    "image_size": "images {}",
    "test_frames": "{} test frames",
}
FOLDERS = ("data.root", "data.train_scenes", "data.test_scenes", "data.val_scenes", "data.pgt")
"""Settings that say where the data lie, and so name the same data in many ways."""


def column_facts(runs: Sequence[Run]) -> dict[str, str]:
    """What the runs of one scene share.

    A run without a fact matches every value: older runs lack some.

    Raises:
        ConfigError: two runs differ in a fact, so that their errors do not compare.
    """
    facts = {}
    for fact in (*FACTS, *CLIP_FACTS):
        newest = {run.settings[fact]: run for run in reversed(runs) if fact in run.settings}
        if len(newest) > 1:
            counts = Counter(run.settings[fact] for run in runs if fact in run.settings)
            (one, many), (other, few) = counts.most_common(2)
            why = REASONS.get(fact, f"errors on another {fact.replace('_', ' ')} say something else")
            raise ConfigError(
                f"runs on {runs[0].scene} differ in {fact} and cannot share a column ({why}): {newest[one]} has {one} "
                f"({many} in all), {newest[other]} has {other} ({few}); give --tag {fact}={one} or --tag {fact}={other}"
            )
        if newest:
            facts[fact] = next(iter(newest))
    return facts


def missing_facts(runs: Sequence[Run]) -> list[str]:
    """A note on the facts that some runs lack; none where all have all."""
    clips = [run for run in runs if run.settings.get("task") == "relative"]
    missing = {fact: sum(fact not in run.settings for run in runs) for fact in FACTS}
    missing |= {fact: sum(fact not in run.settings for run in clips) for fact in CLIP_FACTS}
    if not any(missing.values()):
        return []
    names = ", ".join(fact.replace("_", " ") for fact, count in missing.items() if count)
    return [
        f"{max(missing.values())} of {len(runs)} runs do not record {names}: taken to match the others, not checked"
    ]


def describe_facts(facts: Mapping[str, str]) -> str:
    """The facts of a column in words."""
    parts = ["absolute poses"] if "task" in facts else []
    if facts.get("task") == "relative":
        stride = facts.get("stride", "1")
        every = "" if stride == "1" else f", every {stride}th"
        axes = "the first camera's" if facts.get("relative_frame") == "camera" else "the world's"
        parts = [f"poses relative to the first of {facts.get('clip_length', '?')} frames{every}, in {axes} axes"]
    parts += [caption.format(facts[fact]) for fact, caption in CAPTIONS.items() if fact in facts]
    if facts.get("unit", "m") != "m":
        parts.append("positions in units of the scene, not metres")
    return ", ".join(parts) or "split and ground truth unknown"


def find_tested_fact(scene: str, facts: Mapping[str, str], fact: str) -> str | None:
    """A fact of the scene that a column's errors are of: of `den to chess`, trained in one and tested in the other, a
    run has the ground truth `synthetic+original`."""
    value = facts.get(fact)
    if value is None or "+" in scene.rpartition(" to ")[2]:
        return value
    return value.rpartition("+")[2]


def same_data(runs: Sequence[Run]) -> bool:
    """Whether runs have the same scene, split and number of test frames, whatever folder they read them from."""
    values = {tuple(run.settings.get(fact) for fact in ("scene", "split", "test_frames")) for run in runs}
    return len(values) == 1 and None not in next(iter(values))


def differing_settings(runs: Iterable[Run], ignore: Iterable[str] = ()) -> dict[str, list[str]]:
    """Settings of the runs that differ, with their values; a run without a setting matches every value.

    Args:
        runs: two or more, or nothing differs.
        ignore: further names to leave out, beside seeds and what no result depends on.
    """
    left_out = {"seed", *(f"data.{name}" for name in OPERATIONAL), *ignore}
    values: dict[str, set[str]] = {}
    for run in runs:
        for name in run.params.keys() - left_out:
            values.setdefault(name, set()).add(run.params[name])
    return {name: sorted(found) for name, found in sorted(values.items()) if len(found) > 1}
