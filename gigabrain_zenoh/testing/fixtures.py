"""Fixtures for pytest. Use them by `pytest_plugins = ["gigabrain_zenoh.testing.fixtures"]`."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from gigabrain_zenoh.testing.processes import Home, ServiceManager


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Home]:
    """Folders for the processes of one test. The processes end with the test."""
    home = Home(tmp_path)
    yield home
    home.close()


@pytest.fixture(scope="module")
def shared_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Home]:
    """Folders for processes that the tests of a module share."""
    home = Home(tmp_path_factory.mktemp("home"))
    yield home
    home.close()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Put a folder of packages on `sys.path`; unload their modules afterwards."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    yield folder
    for name, module in list(sys.modules.items()):
        if folder in Path(getattr(module, "__file__", None) or "").parents:
            del sys.modules[name]


@pytest.fixture
def service_manager(tmp_path: Path) -> Iterator[ServiceManager]:
    """A service manager that listens at `notify` in the test's folder."""
    manager = ServiceManager(f"{tmp_path}/notify")
    yield manager
    manager.close()
