"""Things and tags of a world file in a rendered camera: they have their places and sizes."""

import math
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from gigabrain_drivers.cameras.rendered import Renderer, View
from gigabrain_drivers.driver.catalog import load_robot, make_driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.driver import MujocoDriver
from gigabrain_drivers.sim.graphics import open_graphics
from gigabrain_drivers.sim.tag_plates import rectangles
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.vision.camera_model import CameraModel
from gigabrain_zenoh.vision.tags import TagFinder, cells, yaw_of
from gigabrain_zenoh.vision.thing_places import thing_place
from tests.unit.vision.tag_scenes import judge

FRONT = load_robot("turtlebot3_waffle").cameras[0]
MODEL = CameraModel(FRONT)
WORLD = """
size: [6, 6]
start: [0, 0, 0]
tags:
  - {id: 7, at: [1.5, 0.3], yaw: 3.1416, z: 0.25}
  - {id: 130, at: [1.8, -0.4], yaw: 2.6, z: 0.3, size: 0.2}
  - {id: 586, at: [1.2, -0.1], yaw: -2.7, z: 0.2, size: 0.1}
"""
SIZES = {130: 0.2, 586: 0.1}


def exposure(world: str) -> tuple[np.ndarray, np.ndarray]:
    """Return picture and depth of a Waffle's camera at the start of a world."""
    try:
        open_graphics(64, 64).free()
    except ConfigError as error:
        pytest.skip(str(error))
    _, driver = make_driver("turtlebot3_waffle", Run(folder=Path(), world=world, cameras=True))
    assert isinstance(driver, MujocoDriver)
    (_, scene), (_, poses) = driver._world.scene()
    with closing(Renderer({"front": View(FRONT, 0, errors=False)})) as renderer:
        renderer.show(scene)  # type: ignore[arg-type]
        frame = renderer.expose(poses, ["front"])["front"]  # type: ignore[arg-type]
    assert frame.picture is not None
    assert frame.depth is not None
    return frame.picture, frame.depth


def world_file(tmp_path: Path, text: str) -> str:
    path = tmp_path / "room.yaml"
    path.write_text(text)
    return str(path)


def test_tags_are_found_at_their_places_by_our_finder_and_by_pupil_apriltags(tmp_path):
    picture, depth = exposure(world_file(tmp_path, WORLD))
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    found = {tag.id: tag for tag in TagFinder(sizes=SIZES).find(grey, MODEL, depth)}
    for tag, place, yaw in (
        (7, (1.5, 0.3, 0.25), 3.1416),
        (130, (1.8, -0.4, 0.3), 2.6),
        (586, (1.2, -0.1, 0.2), -2.7),
    ):
        assert found[tag].position == pytest.approx(place, abs=0.01)
        assert math.remainder(yaw_of(found[tag].orientation) - yaw, math.tau) == pytest.approx(
            0, abs=0.03
        )
    judged = {one.tag_id: one.corners - 0.5 for one in judge().detect(grey)}
    assert set(judged) == set(found)
    for tag, corners in judged.items():
        assert np.abs(corners - np.array(found[tag].corners)).max() < 0.6


def test_things_are_placed_and_measured_by_box_and_depth(tmp_path):
    text = "size: [6, 6]\nstart: [0, 0, 0]\n"
    for line, label, place, size in (
        ("balls: [{at: [1.2, 0.1]}]", "ball", (1.2, 0.1, 0.1), (0.2, 0.2)),
        ("cans: [{at: [0.9, -0.1]}]", "can", (0.9, -0.1, 0.06), (0.07, 0.12)),
        ("boxes: [{at: [1.3, 0], size: [0.16, 0.16, 0.16], yaw: 0.4}]", "cube",
         (1.3, 0.0, 0.08), (0.21, 0.16)),
    ):  # fmt: skip
        empty, _ = exposure(world_file(tmp_path, text))
        picture, depth = exposure(world_file(tmp_path, text + line + "\n"))
        rows, columns = np.nonzero(np.abs(picture.astype(int) - empty).max(axis=2) > 45)
        box = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
        placed = thing_place(label, tuple(map(float, box)), MODEL, depth)
        assert placed
        assert placed.position[:2] == pytest.approx(place[:2], abs=0.03)
        assert placed.position[2] == pytest.approx(place[2], abs=0.04)
        assert placed.size == pytest.approx(size, abs=0.05)


def test_the_start_of_the_playroom_is_clear():
    world = load_world("playroom", 0)
    assert min(one.distance(world.start.x, world.start.y) for one in world.shapes) > 0.3
    assert len(world.shapes) < 60


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("tags: [{id: 587, at: [1, 1]}]", "room.yaml:2: .*0 to 586"),
        ("tags: [{id: 30, at: [1, 1], family: 16h5}]", "room.yaml:2: .*0 to 29"),
        ("tags: [{id: 7}]", "room.yaml:2: .*at"),
        ("tags: [{id: 7, at: [1, 1], family: 9x9}]", "room.yaml:2: .*36h11"),
        ("balls: [{at: [1, 1], material: fluff}]", "room.yaml:.*no material 'fluff'"),
        ("cans: [{at: [1, 1], height: -1}]", "room.yaml:2: "),
    ],
)
def test_an_invalid_thing_or_tag_is_refused_with_its_line(tmp_path, line, expected):
    with pytest.raises(ConfigError, match=expected):
        load_world(world_file(tmp_path, f"size: [4, 4]\n{line}\n"), 0)


def test_rectangles_of_a_tag_cover_each_white_cell_once():
    white = cells(7)
    times = np.zeros(white.shape, int)
    for left, top, right, bottom in rectangles(white):
        times[top:bottom, left:right] += 1
    assert (times == white).all()
