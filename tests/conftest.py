"""Fixtures that several tests share."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.stack import Home


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
