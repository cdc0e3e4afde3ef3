"""A connection as scripts and notebooks use it, rightly and wrongly."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

import gigabrain_zenoh
from gigabrain_zenoh.client.connection import Connection
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.processes import PROCESSES
from gigabrain_zenoh.testing.in_memory import Net


def connection(opened: list[Robot]) -> Connection:
    @asynccontextmanager
    async def opening() -> AsyncIterator[Robot]:
        opened.append(Robot(Net().two))
        yield opened[-1]

    return Connection(opening)


def test_a_connection_can_be_used_again_as_by_a_cell_of_a_notebook() -> None:
    opened = list[Robot]()
    one = connection(opened)
    for _ in range(2):
        with one as robot:
            assert robot.state is None
    assert len(opened) == 2


async def test_so_can_one_with_asyncio() -> None:
    opened = list[Robot]()
    one = connection(opened)
    for _ in range(2):
        async with one as robot:
            assert robot is opened[-1]
    assert len(opened) == 2


@pytest.mark.parametrize("name", ["move", "tasks", "read_state", "state"])
def test_a_robot_without_a_with_says_how_it_is_used(name: str) -> None:
    with pytest.raises(AttributeError, match=rf"no {name!r}; use `with gigabrain_zenoh.connect"):
        getattr(gigabrain_zenoh.connect(), name)


def test_what_a_robot_has_not_is_not_there_either() -> None:
    assert not hasattr(gigabrain_zenoh.connect(), "_repr_html_")


def test_a_name_that_no_request_has_room_for_is_refused() -> None:
    with pytest.raises(ConfigError, match="source: expected at most 64 characters, got 65"):
        gigabrain_zenoh.connect(source="x" * 65)


@pytest.mark.parametrize("name", PROCESSES)
def test_no_script_takes_the_name_of_a_process_of_the_robot(name: str) -> None:
    text = f"source: {name!r} is a process of the robot itself; choose another name"
    with pytest.raises(ConfigError, match=text):
        gigabrain_zenoh.connect(source=name)


def test_a_name_that_only_resembles_one_is_its_own() -> None:
    for name in ("", "my-control", "control-2"):
        gigabrain_zenoh.connect(source=name)
