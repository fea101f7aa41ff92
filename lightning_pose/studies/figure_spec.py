"""The `figure` entry of a sweep file: what the study's figure and table show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lightning_pose.errors import ConfigError
from lightning_pose.metrics.catalog import MEDIANS, find_metric
from lightning_pose.sweeps.space import BASE, MEASURES, Parameter, normalize_key, suggest_name

__all__ = ["FigureSpec", "parse_figure_spec"]

KINDS = ("line", "bar", "curve", "pictures", "neighbours")
IN_THE_SCENE = ("pictures", "neighbours")  # they show no metric
FIELDS = ("x", "y", "kind", "log", "beside", "title", "table", "labels")


@dataclass(frozen=True)
class FigureSpec:
    """A figure and a table.

    Attributes:
        kind: `line` or `bar` over a setting; `curve` over whatever a trial's own curves run over, one line a trial;
            `pictures` of keypoints; `neighbours` of images, seen in the scene.
        x: the setting along the horizontal axis; empty for all kinds but lines and bars.
        y: metrics, or curves, one panel each.
        log: which axes are logarithmic.
        beside: baselines that are drawn with the model, by name.
        title: the heading; the study's name if not given.
        table: columns of the table beside the settings.
        labels: what axes and columns are called, by setting or metric.
    """

    kind: str
    x: str
    y: tuple[str, ...]
    log: tuple[str, ...]
    beside: tuple[str, ...]
    title: str | None
    table: tuple[str, ...]
    labels: Mapping[str, str]

    def label(self, name: str) -> str:
        """The text for a setting or a metric on axes and in tables."""
        return self.labels.get(name) or _default_label(name)


def parse_figure_spec(raw: object, measure: str | None, space: Sequence[Parameter]) -> FigureSpec | None:
    """Read the `figure` of a sweep file; None where there is none.

    Raises:
        ConfigError: an entry is malformed; the message names it.
    """
    if raw is None:
        return None
    if not isinstance(raw, Mapping):
        raise ConfigError(f"figure is {raw!r}; give {{x: model.layers, y: [test/position_median_m]}}")
    for field in raw:
        if field not in FIELDS:
            raise ConfigError(f"figure has no entry {field!r}; {suggest_name(str(field), FIELDS)}")
    kind = raw.get("kind", "line")
    if kind not in KINDS:
        raise ConfigError(f"figure.kind is {kind!r}; {suggest_name(str(kind), KINDS)}")
    y = _parse_names(raw.get("y", []), "y")
    if not y and kind not in IN_THE_SCENE:
        y = tuple(f"{'test' if measure == 'test' else 'val'}/{name}" for name in MEDIANS)
    table = _parse_names(raw.get("table", []), "table")
    for metric in (*y, *table):
        if not metric.startswith(MEASURES[measure]):
            raise ConfigError(
                f"figure shows {metric}, but trials with `measure: {measure or 'null'}` have "
                f"{', '.join(MEASURES[measure])} metrics; name one of these, or set measure"
            )
    log = _parse_names(raw.get("log", []), "log")
    if not set(log) <= {"x", "y"}:
        raise ConfigError(f"figure.log is {list(log)}; give [x], [y] or [x, y]")
    return FigureSpec(
        kind=kind,
        x=_parse_axis(raw.get("x"), kind, space),
        y=y,
        log=log,
        beside=_parse_names(raw.get("beside", []), "beside"),
        title=raw.get("title"),
        table=table or (() if kind in ("curve", *IN_THE_SCENE) else y),
        labels=_parse_labels(raw.get("labels") or {}),
    )


def _parse_axis(x: object, kind: str, space: Sequence[Parameter]) -> str:
    keys = [parameter.key for parameter in space]
    if kind in ("curve", *IN_THE_SCENE):
        if x is not None:
            raise ConfigError(
                f"figure.x is {x}, but a figure of kind {kind} has no setting along its axis; leave it out"
            )
        return ""
    name = normalize_key(x)
    if f"{name}.class_path" in keys:
        return f"{name}.class_path"
    if name not in keys:
        raise ConfigError(f"figure.x is {x}, which is not searched; {suggest_name(name, keys)}")
    return name


def _parse_names(value: object, field: str) -> tuple[str, ...]:
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"figure.{field} is {value!r}; give a list of names")
    return tuple(names)


def _parse_labels(raw: object) -> dict[str, str]:
    if not isinstance(raw, Mapping):
        raise ConfigError(f"figure.labels are {raw!r}; give them by name, as {{model.layers: convolutions}}")
    return {str(name): str(label) for name, label in raw.items()}


SETTING_LABELS = {"class_path": "features", "root": "scene", BASE: "system"}


def _default_label(name: str) -> str:
    """A metric's title and unit, or the last part of a setting's name, with spaces."""
    metric = find_metric(name) if "/" in name else None
    if metric is not None:
        return metric.label
    last = name.rpartition("/")[2] if "/" in name else name.rpartition(".")[2]
    return SETTING_LABELS.get(last, last.replace("_", " "))
