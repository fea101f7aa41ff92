"""What tests share: nothing of the user's own is read or written, and one tiny training run serves many."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:  # they take seconds to import, and most tests do without
    from tests.helpers import Trained, Workplace
    from tests.rooms import MappedRoom

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported: each test process has one core
# Tests start processes: without compiled modules on disk each would compile all that it imports, for seconds.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False


def pytest_configure() -> None:
    """Check shapes in signatures; before a test imports the modules."""
    from tests import shapes

    shapes.turn_on_checks()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="run tests too that take more than ten seconds")


@pytest.fixture
def long(pytestconfig: pytest.Config) -> None:
    """Skips a test that takes long, unless `--long` is given."""
    if not pytestconfig.getoption("--long"):
        pytest.skip("takes long; --long runs it")


@pytest.fixture(autouse=True, scope="session")
def _hermetic(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIGHTNING_POSE_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True)
def _no_store_of_another_test(monkeypatch: pytest.MonkeyPatch) -> None:
    """`mlflow.set_tracking_uri` keeps the store in the environment, where a later test would read it."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of 24 training and 10 test frames; not to be changed."""
    from tests.helpers import write_scene

    return write_scene(tmp_path_factory.mktemp("scenes") / "wall")


@pytest.fixture(scope="session")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty MLflow store, to be copied: making one takes seconds."""
    from mlflow import MlflowClient

    file = tmp_path_factory.mktemp("store") / "mlflow.db"
    MlflowClient(f"sqlite:///{file}").search_experiments()
    return file


@pytest.fixture
def workplace(tmp_path: Path, scene: Path, store: Path) -> Workplace:
    """A fresh folder to run commands in."""
    from tests.helpers import Workplace

    return Workplace.make(tmp_path / "workplace", scene, store)


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory, scene: Path, store: Path) -> Trained:
    """A tiny SurfLSTM, trained for two epochs; not to be changed."""
    from tests.helpers import Trained, Workplace

    return Trained.make(Workplace.make(tmp_path_factory.mktemp("trained") / "workplace", scene, store))


@pytest.fixture(scope="session")
def mapped_room(tmp_path_factory: pytest.TempPathFactory) -> MappedRoom:
    """A landmark map of a small room; not to be changed."""
    from tests.rooms import MappedRoom

    return MappedRoom.make(tmp_path_factory.mktemp("mapped"))
