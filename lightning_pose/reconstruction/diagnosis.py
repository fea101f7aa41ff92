"""Says what is wrong where no poses, or poses of a part, were found: which frames, and what to film instead."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from lightning_pose.reconstruction.matches import MIN_MATCHES

__all__ = ["PairFacts", "describe_parallax", "describe_rows", "diagnose", "find_components"]

FEW_KEYPOINTS = 100

TURNED = (5, 6)
"""`TwoViewGeometryConfiguration` of a camera that only turned, and of one that turned or sees a plane."""

CAPTURE = "move sideways while you film, slowly, and let each place be seen from several sides"


TURNED_SHARE = 0.9
"""Where more of the pairs are of a camera that only turned, poses of cameras close together are not to be believed."""

PANORAMA_SPAN, SHORT_SPAN = 0.2, 0.15
"""Distance between cameras, as a share of the distance to what they see: 0.11 of a camera that only turned, for which
the mapper invents places, and 0.3 or more of usual videos."""


class PairFacts(NamedTuple):
    """A verified pair of frames: rows of both, how many matches agree, and its `TwoViewGeometryConfiguration`."""

    first: int
    second: int
    matches: int
    kind: int


def describe_rows(rows: Iterable[int], names: Sequence[str]) -> str:
    """Frames as runs in words, such as `a.jpg to f.jpg (6)`.

    >>> describe_rows([0, 1, 2, 4], ["a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg"])
    'a.jpg to c.jpg (3), e.jpg'
    """
    ordered = np.array(sorted(rows), int)
    runs = np.split(ordered, np.flatnonzero(np.diff(ordered) > 1) + 1) if len(ordered) else []
    ends = [(names[int(run[0])], names[int(run[-1])], len(run)) for run in runs[:6]]
    texts = [first if count == 1 else f"{first} to {last} ({count})" for first, last, count in ends]
    more = [f"and {len(runs) - 6} more stretches"] if len(runs) > 6 else []
    return ", ".join([*texts, *more])


def find_components(pairs: Iterable[PairFacts], n: int) -> list[list[int]]:
    """Rows of frames that hang together by verified pairs, the largest group first."""
    group = list(range(n))

    def root(i: int) -> int:
        while group[i] != i:
            group[i] = group[group[i]]
            i = group[i]
        return i

    for pair in pairs:
        group[root(pair.first)] = root(pair.second)
    members: dict[int, list[int]] = {}
    for i in range(n):
        members.setdefault(root(i), []).append(i)
    return sorted(members.values(), key=lambda rows: (-len(rows), rows[0]))


def describe_parallax(pairs: Sequence[PairFacts], span: float) -> tuple[str, bool]:
    """What is wrong with a scene whose cameras are close together, and whether its poses are worthless.

    Args:
        pairs: the verified pairs.
        span: extent of the camera centres, as a share of the median distance to the points.

    Returns:
        the text, empty if the cameras are far enough apart, and whether to refuse the scene.
    """
    turned = sum(pair.kind in TURNED for pair in pairs)
    if turned > TURNED_SHARE * len(pairs) and span < PANORAMA_SPAN:
        return (
            f"too little parallax: in {turned} of {len(pairs)} matching pairs the camera only turned; {CAPTURE}",
            True,
        )
    if span < SHORT_SPAN:
        return f"little parallax: the cameras span {span:.0%} of the distance to what they see; {CAPTURE}", False
    return "", False


def diagnose(
    names: Sequence[str], keypoints: np.ndarray, pairs: Sequence[PairFacts], posed: Iterable[int]
) -> list[str]:
    """Reasons why frames have no pose, the likeliest first; empty if all have one.

    Args:
        names: of N frames.
        keypoints: (N,) how many each frame has.
        pairs: the verified pairs.
        posed: rows of the frames that have a pose in the scene.
    """
    left = sorted(set(range(len(names))) - set(posed))
    if not left:
        return []
    reasons = []
    poor = [i for i in left if keypoints[i] < FEW_KEYPOINTS]
    if poor:
        reasons.append(
            f"{len(poor)} frames have fewer than {FEW_KEYPOINTS} keypoints, because they are blurred, dark or show "
            f"plain walls: {describe_rows(poor, names)}"
        )
    turned = [pair for pair in pairs if pair.kind in TURNED]
    if len(pairs) and 2 * len(turned) > len(pairs):
        reasons.append(
            f"too little parallax: in {len(turned)} of {len(pairs)} matching pairs the camera only turned, or all that "
            f"is seen is one plane; {CAPTURE}"
        )
    matched = {row for pair in pairs for row in (pair.first, pair.second)}
    alone = [i for i in left if i not in matched and i not in poor]
    if alone:
        reasons.append(
            f"too few matches: {len(alone)} frames share {MIN_MATCHES} matches with no other: "
            f"{describe_rows(alone, names)}; take more frames there (--every 1), or film more slowly"
        )
    groups = [rows for rows in find_components(pairs, len(names)) if len(rows) > 1]
    if len(groups) > 1:
        parts = "; ".join(describe_rows(rows, names) for rows in groups[:4])
        reasons.append(f"several pieces, {len(groups)}, which no match joins: {parts}; film what lies between them")
    if not reasons:
        reasons.append(f"their matches fit no camera pose: {describe_rows(left, names)}; {CAPTURE}")
    return reasons
