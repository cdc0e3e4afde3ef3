"""Fixtures that several tests share."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

import gigabrain_zenoh.recording.arithmetic  # noqa: F401  before anything imports numpy
from tests.stack import Home

STARTS_PROCESSES = {"home", "shared_home"}  # fixtures

# how long an example takes says something of the machine, and nothing of the code
settings.register_profile("gigabrain", deadline=None)
settings.load_profile("gigabrain")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what starts processes as `system`: those tests have the machine to themselves."""
    for item in items:
        if STARTS_PROCESSES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.system)


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Home]:
    """Folders of its own for what a test starts; whatever it starts ends with the test."""
    place = Home(tmp_path)
    yield place
    place.close()


@pytest.fixture(scope="module")
def shared_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Home]:
    """The same for all tests of a module."""
    place = Home(tmp_path_factory.mktemp("home"))
    yield place
    place.close()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of packages; what was imported from it goes with it."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    yield folder
    for name, module in list(sys.modules.items()):
        if folder in Path(getattr(module, "__file__", None) or "").parents:
            del sys.modules[name]


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The keys of a fleet with the robots red and blue; nobody may change them."""
    pytest.importorskip("cryptography")
    from tests.keys_rig import make_fleet

    return make_fleet(tmp_path_factory.mktemp("keys") / "home", "home")
