"""A report for people: LaTeX sets everything that must be said."""

from __future__ import annotations

import re

from lightning_pose.reports.published_rows import add_published
from lightning_pose.reports.text_formats import as_latex, as_markdown
from tests.stores import FakeRun

OUTDOORS = {"dataset": "cambridge", "ground_truth": "sfm"}


def test_latex_sets_what_must_be_said_below_the_table(table) -> None:
    report = table(FakeRun(tags={"test_frames": "150"}), FakeRun(scene="my_den", tags={"split": "blocks"}))
    add_published(report, [2])
    out = as_latex(report)
    assert [line for line in out.splitlines() if line.startswith("%")] == [r"% \usepackage{booktabs}"]
    _, below = out.split("\\end{tabular}\n")
    assert re.fullmatch(r"\\par\\smallskip\n\{\\footnotesize\\raggedright\n(.+\\par\n)+\}", below)
    for says in (
        r"Median errors on the test frames, position in metres / orientation in degrees.\par",
        "chess: absolute poses, official split, original ground truth, images 640x480, 150 test frames",
        r"my\_den: absolute poses, blocks split",
        "runs: of each system and scene, the run that is best by val/position\\_median\\_m",
        "do not compare: chess is a cut, 150 test frames of 2000",
        r"$^{\dagger}$ published, not measured here",
    ):
        assert says in below


def test_a_column_for_the_mean_of_each_dataset(table) -> None:
    report = table(
        FakeRun(test=(0.1, 8.0)),
        FakeRun(scene="fire", test=(0.3, 6.0)),
        FakeRun(scene="KingsCollege", test=(2.0, 3.0), tags=OUTDOORS),
        FakeRun("NodePose", test=(0.2, 7.0)),
        FakeRun("NodePose", "KingsCollege", test=(1.0, 4.0), tags=OUTDOORS),
    )
    assert as_markdown(report).splitlines()[:4] == [
        "| system | features | chess | fire | KingsCollege | mean 7scenes | mean cambridge |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: |",
        "| NodePose | surf | 0.200 / **7.00** | – | **1.000** / 4.00 | 0.200 / 7.00 [1 of 2] | **1.000** / 4.00 |",
        "| SurfLSTM | surf | **0.100** / 8.00 | 0.300 / 6.00 | 2.000 / **3.00** | 0.200 / 7.00 | 2.000 / **3.00** |",
    ]
    assert r"\begin{tabular}{llrrrrr}" in as_latex(report)


def test_a_scene_may_have_the_name_of_a_column(table) -> None:
    report = table(FakeRun(scene="mean", test=(0.1, 8.0)), FakeRun(scene="den", test=(0.3, 6.0)))
    assert as_markdown(report).splitlines()[2] == "| SurfLSTM | surf | 0.300 / 6.00 | 0.100 / 8.00 | 0.200 / 7.00 |"
