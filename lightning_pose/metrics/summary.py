"""What is reported of a set of pose errors: median, mean, 95th percentile and recalls.

Apart from `pose_metrics`, because torchmetrics takes seconds to import and reports and baselines do without it.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from lightning_pose.errors import ConfigError
from lightning_pose.metrics.catalog import ERRORS

__all__ = ["summarize_errors"]


def summarize_errors(
    position_error_m: torch.Tensor | np.ndarray, orientation_error_deg: torch.Tensor | np.ndarray
) -> dict[str, float]:
    """Median, mean and 95th percentile of both errors, and the recalls as fractions from 0 to 1.

    The median is the mean of the middle two, percentiles are linearly interpolated. An error that is NaN
    (a prediction that diverged) counts as infinite, so that it is never within a threshold.

    Args:
        position_error_m: any shape, metres.
        orientation_error_deg: as many, degrees.

    Returns:
        The metrics of `catalog.ERRORS`: medians, means, 95th percentiles, and the recalls that it has.

    Raises:
        ConfigError: there are no errors, or not as many of one as of the other.
    """
    position, orientation = _flatten_errors(position_error_m), _flatten_errors(orientation_error_deg)
    if not len(position) or len(position) != len(orientation):
        raise ConfigError(
            f"{len(position)} position errors and {len(orientation)} orientation errors have no summary; "
            "give one of each for at least one frame (is the split empty?)"
        )
    summary = {}
    for name, unit, errors in (("position", "m", position), ("orientation", "deg", orientation)):
        summary[f"{name}_median_{unit}"] = _interpolate_quantile(errors, 0.5)
        summary[f"{name}_mean_{unit}"] = float(errors.mean())
        summary[f"{name}_p95_{unit}"] = _interpolate_quantile(errors, 0.95)
    for name, metric in ERRORS.items():
        if metric.within is not None:
            metres, degrees = metric.within
            summary[name] = float(np.mean((position <= metres) & (orientation <= degrees)))
    return summary


def _flatten_errors(errors: torch.Tensor | np.ndarray) -> np.ndarray:
    values = torch.as_tensor(errors).detach().cpu().double().flatten().numpy()
    return np.where(np.isnan(values), np.inf, values)


def _interpolate_quantile(errors: np.ndarray, q: float) -> float:
    """The q-quantile by linear interpolation that keeps infinities, of which np.quantile makes NaN."""
    ordered = np.sort(errors)
    place = q * (len(ordered) - 1)
    below, above = ordered[math.floor(place)], ordered[math.ceil(place)]
    return float(below if below == above else below + (above - below) * (place % 1))
