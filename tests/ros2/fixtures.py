"""Fixtures with real ROS 2, to be imported by a `conftest.py`."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.ros2.environment import NotBuilt, build
from tests.ros2.judge import Judge, judging


@pytest.fixture(scope="session")
def ros2() -> Path:
    """Build the environment with ROS 2 if it is missing; return its interpreter.

    If it cannot be built, the tests are skipped; in CI they fail.
    """
    try:
        return build()
    except NotBuilt as error:
        if "CI" in os.environ:
            raise
        pytest.skip(f"no ROS 2 environment: {error}")


@pytest.fixture
def judge(ros2: Path, tmp_path: Path) -> Iterator[Judge]:
    """Real ROS 2 in a domain for one test."""
    (folder := tmp_path / "ros2").mkdir()
    with judging(ros2, folder) as judge:
        yield judge


@pytest.fixture(scope="module")
def shared_judge(ros2: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Judge]:
    """Real ROS 2 in a domain that the tests of a module share."""
    with judging(ros2, tmp_path_factory.mktemp("ros2")) as judge:
        yield judge
