"""Train two systems on one small synthetic room, and print them in one table beside the baselines.

    python examples/compare_systems.py

It writes the room to `room/`, and runs and checkpoints to `mlruns/`, in the current folder.
"""

from pathlib import Path

from lightning_pose.__main__ import main
from lightning_pose.scenes.synthetic import render_room

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
SYSTEMS = ("linear_posenet", "kernel_posenet")


def compare_systems() -> None:
    """Run `fit` for each system, then `report`."""
    room = render_room(Path("room"), frames=40, size=(160, 120))
    for system in SYSTEMS:
        if main(["fit", "--config", str(CONFIGS / f"{system}.yaml"), "--data.root", str(room)]) != 0:
            raise SystemExit(f"fit of {system} has failed")
    main(["report", "--baselines"])


if __name__ == "__main__":
    compare_systems()
