"""What every test ends with: `report` for all of it, `images` and `clips` for what is judged of each kind of model."""

from lightning_pose.evaluation.callback import TestReport
from lightning_pose.evaluation.table import print_results

__all__ = ["TestReport", "print_results"]
