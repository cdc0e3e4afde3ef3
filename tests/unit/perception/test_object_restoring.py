"""The next perception process continues with the objects and tags of the map."""

import asyncio
from pathlib import Path

import numpy as np
import pytest

from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.objects import MapObject, MapTag, ObjectsRequest
from gigabrain_schemas.topics import OBJECTS_CHANGE
from gigabrain_zenoh.mapping import map_file, object_file
from gigabrain_zenoh.mapping.localizer import Place
from gigabrain_zenoh.mapping.object_file import ObjectFile
from gigabrain_zenoh.mapping.odometry import OdometryFusion, OdometrySample
from gigabrain_zenoh.perception.object_server import ObjectServer
from gigabrain_zenoh.perception.surroundings import Surroundings
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.samples import WAFFLE

CAN = MapObject(id=1, label="can", x=1, y=2, z=0.1, size=(0.1, 0.1), confidence=0.9, seen=5)
TAG = MapTag(id=5, x=0, y=0, z=0.2, yaw=0, size=0.16)


@pytest.fixture(autouse=True)
def _own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def server(folder: Path, boot: int, *, restored: bool = False) -> ObjectServer:
    """Return the server of a new process with a growing map."""
    new = ObjectServer(Net().one, str(folder), OdometryFusion)
    new.use_map("", "slam")
    if restored:
        new.restore(boot)
    new.restart(boot)
    return new


def server_with_objects(folder: Path) -> ObjectServer:
    """Return the server of a process that has seen a can and a tag."""
    new = server(folder, 7)
    new.memory.restore([(CAN, None)])
    new.tags.restore([(TAG, None)])
    new.publish(500)
    return new


def known(found: ObjectServer) -> list[str | int]:
    return [*(one.label for one in found.present.objects), *(one.id for one in found.present.tags)]


async def test_objects_of_a_map_saved_meanwhile_survive_a_restart_of_perception(
    tmp_path: Path,
) -> None:
    first = server_with_objects(tmp_path)
    first.saved_as("office")
    await first.finish_writing()
    second = server(tmp_path, 7, restored=True)
    second.publish(600)
    await second.finish_writing()
    third = server(tmp_path, 7, restored=True)  # the name is also kept
    await third.finish_writing()
    assert known(second) == known(third) == ["can", 5]
    assert b'"map":"office"' in (tmp_path / "objects.json").read_bytes()


async def test_objects_survive_restarts_of_the_driver_and_then_of_perception(
    tmp_path: Path,
) -> None:
    first = server_with_objects(tmp_path)
    first.restart(8)
    await first.finish_writing()
    second = server(tmp_path, 8, restored=True)
    await second.finish_writing()
    assert known(second) == ["can", 5]


async def test_objects_are_not_restored_into_a_map_that_was_loaded_since(
    tmp_path: Path,
) -> None:
    object_file.save(map_file.saved_map_path("office"), ObjectFile(tags=(TAG,)))
    first = server_with_objects(tmp_path)
    first.use_map("office", "slam")
    await first.finish_writing()
    second = server(tmp_path, 7, restored=True)
    await second.finish_writing()
    assert known(second) == [5]


async def test_a_failed_write_is_repeated_once_there_is_room(tmp_path: Path) -> None:
    """Nothing new is seen in the meantime."""
    folder = tmp_path / "full"
    folder.write_text("no folder can be made here")
    found = server_with_objects(folder)
    await found.finish_writing()
    await asyncio.sleep(0)
    (unsaved,) = found.problems()
    assert (unsaved.code, "load" in unsaved.remedy) == ("objects_unsaved", False)
    folder.unlink()
    found.publish(1000)
    await found.finish_writing()
    await asyncio.sleep(0)
    assert found.problems() == ()
    assert b'"can"' in (folder / "objects.json").read_bytes()


def scan(found: ObjectServer, tick: int, *, localized: bool) -> None:
    """Process a scan at the origin of the map, where the robot sees nothing."""
    still = np.zeros(3)
    seen = Surroundings(
        WAFFLE, WorldModel(scan_ok=True, obstacle_ahead=False), np.empty((0, 2)), np.zeros((1, 3))
    )
    moment = OdometrySample(tick, still, still, slipping=False, jumps=0)
    found.at_scan(seen, Place(still, np.eye(3), localized), moment)


@pytest.mark.parametrize(
    ("asked", "left"),
    [
        (ObjectsRequest(everything=True), []),
        (ObjectsRequest(ids=(1,)), [5]),
        (ObjectsRequest(tags=(5,)), ["can"]),
        (ObjectsRequest(ids=(1,), tags=(9,)), ["can", 5]),  # refused: there is no tag 9
    ],
)
async def test_forgotten_objects_do_not_return_when_the_robot_is_then_lost(
    asked: ObjectsRequest, left: list[str | int]
) -> None:
    net = Net()
    found = ObjectServer(net.one, "", OdometryFusion)
    found.restart(7)
    found.memory.restore([(CAN, None)])
    found.tags.restore([(TAG, None)])
    scan(found, 500, localized=True)
    await net.two.ask(OBJECTS_CHANGE, asked)
    scan(found, 505, localized=False)
    assert known(found) == left
