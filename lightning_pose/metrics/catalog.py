"""The one catalogue of metrics, costs and baselines: names, titles, units, formats and direction; quick to import."""

from __future__ import annotations

from typing import NamedTuple

__all__ = [
    "BASELINES",
    "COSTS",
    "CURVES",
    "ERRORS",
    "MAP",
    "MEDIANS",
    "REFINED",
    "SKILLS",
    "TRAJECTORY",
    "Baseline",
    "Metric",
    "define_recall",
    "find_metric",
    "format_number",
    "reference_baseline",
]


class Metric(NamedTuple):
    """What a number means and how it is shown.

    Attributes:
        title: in words, for axes and for columns of studies.
        unit: of the number, "" where it has none.
        heading: short, with its unit, for columns; a printed table breaks it at the newline.
        form: format specification; "" for three digits, with a comma at each thousand.
        higher_is_better: the direction.
        within: metres and degrees of a recall, None for any other metric.
        printed: whether the table that a test prints has a column of it.
        described: whether the run's description in MLflow has one too.
        objective: whether the trials of a sweep measure it without test frames, so that they may be chosen by it.
    """

    title: str
    unit: str = ""
    heading: str = ""
    form: str = ""
    higher_is_better: bool = False
    within: tuple[float, float] | None = None
    printed: bool = True
    described: bool = False
    objective: bool = True

    @property
    def label(self) -> str:
        """Title and unit."""
        return f"{self.title} ({self.unit})" if self.unit else self.title

    def format(self, value: float) -> str:
        """The value in the metric's format; bytes in a unit that leaves few digits."""
        if self.unit == "bytes":
            sizes = ((1e9, "GB"), (1e6, "MB"), (1e3, "kB"))
            return next((f"{value / size:.3g} {unit}" for size, unit in sizes if value >= size), f"{value:.0f} B")
        return format(value, self.form) if self.form else format_number(value)


def define_recall(metres: float, degrees: float, printed: bool = True, described: bool = False) -> Metric:
    """The share of frames within both bounds, which count as within."""
    length = f"{metres * 100:g} cm" if metres < 1 else f"{metres:g} m"
    title, heading = f"share of frames within {length} and {degrees:g}°", f"{length}\n{degrees:g} deg"
    return Metric(title, "", heading, ".0%", True, (metres, degrees), printed, described)


ERRORS = {
    "position_median_m": Metric("median position error", "m", "median\nm", ".3f", described=True),
    "orientation_median_deg": Metric("median orientation error", "°", "median\ndeg", ".2f", described=True),
    "position_mean_m": Metric("mean position error", "m", "mean\nm", ".3f"),
    "orientation_mean_deg": Metric("mean orientation error", "°", "mean\ndeg", ".2f"),
    "position_p95_m": Metric("95th percentile of position errors", "m", "95 %\nm", ".3f", described=True),
    "orientation_p95_deg": Metric("95th percentile of orientation errors", "°", "95 %\ndeg", ".2f", described=True),
    "recall_1cm_1deg": define_recall(0.01, 1.0, printed=False),
    "recall_2cm_2deg": define_recall(0.02, 2.0, printed=False),
    "recall_5cm_5deg": define_recall(0.05, 5.0, described=True),
    "recall_10cm_5deg": define_recall(0.10, 5.0, described=True),
    "recall_25cm_2deg": define_recall(0.25, 2.0),
    "recall_50cm_5deg": define_recall(0.50, 5.0),
    "recall_5m_10deg": define_recall(5.0, 10.0, printed=False),
}
"""What `summarize_errors` returns: `test/NAME` and `val/NAME` of the model, `baseline/BASELINE/NAME` of a baseline."""

MEDIANS = ("position_median_m", "orientation_median_deg")
"""The two errors by which systems are compared."""

SKILLS = {
    "skill_position": Metric("position error over the baseline's", form=".2f"),
    "skill_orientation": Metric("orientation error over the baseline's", form=".2f"),
}
"""Median errors of the model, divided by those of `reference_baseline`: `test/NAME`."""

MAP = {
    "accepted": Metric("share of frames that are accepted", form=".0%", higher_is_better=True),
    "accepted_position_median_m": Metric("median position error of accepted frames", "m", form=".3f"),
    "accepted_orientation_median_deg": Metric("median orientation error of accepted frames", "°", form=".2f"),
    "coverage_position": Metric("share of positions within their 90 % radius", form=".0%"),
    "coverage_orientation": Metric("share of orientations within their 90 % radius", form=".0%"),
    "radius_median_m": Metric("median 90 % radius of positions", "m", form=".3f"),
    "radius_median_deg": Metric("median 90 % radius of orientations", "°", form=".2f"),
}
"""Of systems for single images, beside their errors: `test/NAME`. Coverage and radii are those of accepted frames."""

REFINED = {
    "alone_position_median_m": Metric("median position error without the map", "m", form=".3f"),
    "alone_orientation_median_deg": Metric("median orientation error without the map", "°", form=".2f"),
}
"""Of systems that a map refines, beside those of `MAP`: `test/NAME`."""

TRAJECTORY = {
    "ate_rmse_m": Metric("absolute trajectory error, aligned", "m"),
    "ate_origin_rmse_m": Metric("absolute trajectory error from the first pose", "m"),
    "rpe_rmse_m": Metric("relative position error of a step", "m"),
    "rpe_rmse_deg": Metric("relative orientation error of a step", "°"),
    "failed_steps": Metric("steps without enough matches"),
}
"""Of clips chained to sequences: `test/NAME` and `baseline/visual_odometry/NAME`; only odometry has failed steps."""

CURVES = {
    "position_median_m_by_length": ERRORS["position_median_m"],
    "orientation_median_deg_by_length": ERRORS["orientation_median_deg"],
    "drift_position_m_by_length": Metric("position error at the end of a clip", "m"),
    "drift_orientation_deg_by_length": Metric("orientation error at the end of a clip", "°"),
    "drift_percent_by_length": Metric("position error at the end of a clip by its length", "%"),
}
"""Metrics over the number of frames of a clip, which is their step in MLflow; named as those of `TRAJECTORY`."""

COSTS = {
    "parameters": Metric("parameters", heading="parameters", form=",.0f"),
    "carried_numbers": Metric("numbers that the checkpoint carries", heading="carried", form=",.0f"),
    "layers": Metric("layers", heading="layers", form=",.0f"),
    "train_seconds": Metric("training time", "s", "train s"),
    "ms_per_frame": Metric("network time per frame", "ms", "ms / frame"),
    "features_ms_per_frame": Metric("feature time per frame", "ms", "features ms / frame"),
    "frame_bytes": Metric("size of a frame's features", "bytes", "frame bytes"),
    "weights_bytes": Metric("size of the trained weights", "bytes", "weights"),
    "checkpoint_bytes": Metric("size of the checkpoint", "bytes", "checkpoint", objective=False),
}
"""What a localizer costs: `cost/NAME`."""


class Baseline(NamedTuple):
    """What a test measures beside the model.

    Attributes:
        clips: it answers for clips; otherwise for single images.
        reads_features: its answer depends on the features, not on poses or images alone.
        reference: skill is relative to it.
    """

    clips: bool = False
    reads_features: bool = False
    reference: bool = False


BASELINES = {
    "train_mean": Baseline(),
    "retrieval_top1": Baseline(reads_features=True, reference=True),
    "retrieval_top5": Baseline(reads_features=True),
    "oracle": Baseline(),
    "no_motion": Baseline(clips=True, reference=True),
    "constant_velocity": Baseline(clips=True),
    "visual_odometry": Baseline(clips=True),
}
"""In the order in which tables have them."""


def reference_baseline(clips: bool) -> str:
    """The name of the baseline that skill is relative to, for models of clips or of single images."""
    return next(name for name, baseline in BASELINES.items() if baseline.reference and baseline.clips == clips)


def find_metric(name: str) -> Metric | None:
    """The entry of a metric by its name in MLflow, such as `test/position_median_m`; None for an unknown one."""
    return (ERRORS | SKILLS | MAP | REFINED | TRAJECTORY | CURVES | COSTS).get(name.rpartition("/")[2])


def format_number(value: float) -> str:
    """Three digits, or all before the point, with a comma at each thousand."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
