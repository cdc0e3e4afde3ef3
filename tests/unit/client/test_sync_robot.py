"""The robot for scripts without asyncio offers all that the asynchronous one does."""

import inspect

import pytest

from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.client.sync_robot import SyncRobot, SyncTasks
from gigabrain_zenoh.client.tasks import Tasks

UNSUPPORTED = {"set_joint_position"}  # no driver obeys it yet


def public(kind: type) -> dict[str, list[tuple[str, object, object]]]:
    """The parameters of each public method."""
    functions = inspect.getmembers(kind, inspect.isfunction)
    found = {name: inspect.signature(one).parameters.values() for name, one in functions}
    return {
        name: [(one.name, one.kind, one.default) for one in given]
        for name, given in found.items()
        if name[0] != "_"
    }


@pytest.mark.parametrize(("sync", "asynchronous"), [(SyncRobot, Robot), (SyncTasks, Tasks)])
def test_each_method_is_there_with_the_same_parameters(sync: type, asynchronous: type) -> None:
    wanted = public(asynchronous)
    assert public(sync) == {name: wanted[name] for name in wanted.keys() - UNSUPPORTED}
