"""The command `extract`: fills the feature cache that a config needs, without training."""

from __future__ import annotations

from lightning_pose.cli import PoseCLI

__all__ = ["main"]


def main(argv: list[str]) -> int:
    """Extract the features of every frame of the config's scene that are not cached yet; return the exit code."""
    cli = PoseCLI(argv, run=False)
    datamodule = cli.datamodule
    report = datamodule.fill(cli.config.scheduler)
    print(
        f"{report.total} frames: {report.computed} extracted, {report.cached} cached, {report.redone} redone, "
        f"{report.seconds_per_image * 1e3:.1f} ms each\nin {datamodule.cache.folder}"
    )
    return 0
