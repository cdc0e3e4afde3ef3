"""Real ROS 2, for the tests in this folder."""

from pathlib import Path

import pytest

from tests.ros2.fixtures import judge, ros2, shared_judge

__all__ = ["judge", "ros2", "shared_judge"]
HERE = Path(__file__).parent


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Leave what uses DDS to `make qa`, as a write can hang beside a listener of cyclonedds."""
    for item in items:
        if HERE in item.path.parents and item.path.name != "test_rmw_zenoh.py":
            item.add_marker(pytest.mark.qa)
