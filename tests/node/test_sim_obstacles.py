"""Obstacles and persons that are added to a running simulation."""

import math
from pathlib import Path

import numpy as np
import pytest

from gigabrain_drivers.driver.catalog import make_driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.body import sim_body
from gigabrain_drivers.sim.live_world import LiveWorld
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.world import Pose, World
from gigabrain_schemas.sim import SimPoses, SimScene, Thing
from gigabrain_zenoh.errors import Refused


def simulation(half: float = 3.0, start: Pose = Pose(0.064, 0, 0)) -> Simulation:  # noqa: B008
    robot, driver = make_driver("turtlebot3_waffle", Run(folder=Path()))
    world = World(name="room", description="", half_x=half, half_y=half, shapes=(), start=start)
    return Simulation(sim_body(robot, driver.options, driver.run), world, 0)


def run_for(sim: Simulation, seconds: float) -> None:
    for _ in range(round(seconds * 100)):
        sim.advance()


@pytest.mark.parametrize(("kind", "distance"), [("box", 0.9), ("cylinder", 0.9)])
def test_an_added_obstacle_is_seen_in_the_next_scan(kind: str, distance: float) -> None:
    sim = simulation()
    run_for(sim, 0.1)
    assert sim.scan()[0] == pytest.approx(3.0, abs=0.05)
    thing = sim.things.add(Thing(kind=kind, x=1.0, size=(0.2, 0.2, 0.5)))  # type: ignore[arg-type]
    assert sim.scan()[0] == pytest.approx(distance, abs=0.05)
    assert (sim.scan()[[20, 340, 180]] > 2.5).all()
    sim.things.remove(thing.name)
    assert sim.scan()[0] == pytest.approx(3.0, abs=0.05)


def test_a_large_rotated_box_is_seen_in_full_width() -> None:
    sim = simulation()
    sim.things.add(Thing(x=2.0, yaw=math.pi / 2, size=(4.0, 0.2, 0.3)))
    ranges = sim.scan()
    assert ranges[0] == pytest.approx(1.9, abs=0.05)
    assert ranges[40] == pytest.approx(1.9 / math.cos(math.radians(40)), abs=0.06)


def test_an_added_box_blocks_the_robot_and_counts_as_contact() -> None:
    sim = simulation()
    sim.things.add(Thing(x=0.8, size=(0.2, 1.0, 0.5)))
    sim.command(0.2, 0.0)
    run_for(sim, 8)
    assert sim.truth.contacts == 1
    assert sim.truth.pose().x < 0.8 - 0.1 - sim.truth.footprint.front + 0.02


def test_a_removed_box_no_longer_blocks_the_robot() -> None:
    sim = simulation()
    sim.things.add(Thing(x=0.8, size=(0.2, 1.0, 0.5), name="gate"))
    sim.things.remove("gate")
    sim.command(0.2, 0.0)
    run_for(sim, 8)
    assert sim.truth.contacts == 0
    assert sim.truth.pose().x > 1.4


def test_an_added_person_walks_to_and_fro_and_stops_for_the_robot() -> None:
    sim = simulation()
    name = sim.things.add(Thing(kind="person", x=2.0, y=-1.0, path=((2.0, 1.0),))).name
    body = sim.model.body("spare/person0").mocapid[0]
    run_for(sim, 1.0)
    assert sim.data.mocap_pos[body][:2] == pytest.approx((2.0, -0.2), abs=0.01)
    run_for(sim, 2.0)
    assert sim.data.mocap_pos[body][:2] == pytest.approx((2.0, 0.6), abs=0.01)
    sim.things.remove(name)
    sim.things.add(Thing(kind="person", x=2.0, path=((-2.0, 0.0),)))
    run_for(sim, 6.0)
    assert sim.person_stood == 1
    assert sim.truth.contacts == 0


def test_a_person_without_a_path_stands_still() -> None:
    sim = simulation()
    sim.things.add(Thing(kind="person", x=1.5))
    run_for(sim, 1.0)
    assert sim.scan()[0] == pytest.approx(1.25, abs=0.05)


@pytest.mark.parametrize(
    ("thing", "complaint"),
    [
        (Thing(x=0.1), "the robot is in the way"),
        (Thing(kind="cylinder", x=0.3, size=(0.4, 0.4, 0.4)), "the robot is in the way"),
        (Thing(kind="person", x=0.6), "the robot is in the way"),
        (Thing(x=5.0), r"\(5.00, 0.00\) is outside the world; expected x from -3.4 to 3.4"),
        (Thing(kind="person", x=1, path=((9.0, 9.0),)), r"\(9.00, 9.00\) is outside the world"),
        (Thing(kind="person", x=2, path=((2.0, 0.0),)), "shorter than 0.2 m"),
    ],
)
def test_an_impossible_obstacle_is_refused_and_adds_nothing(thing: Thing, complaint: str) -> None:
    sim = simulation(half=2.4)
    before = sim.scan()
    with pytest.raises(Refused, match=complaint):
        sim.things.add(thing)
    assert sim.things.all() == ()
    assert sim.scan() == pytest.approx(before, abs=0.1)
    run_for(sim, 0.2)
    assert sim.truth.contacts == 0


def test_obstacles_get_numbered_unique_names() -> None:
    sim = simulation()
    assert sim.things.add(Thing(x=2)).name == "box1"
    assert sim.things.add(Thing(x=2, y=1)).name == "box2"
    sim.things.remove("box1")
    assert sim.things.add(Thing(x=2)).name == "box1"
    with pytest.raises(Refused, match="there is a 'box2' already"):
        sim.things.add(Thing(x=2, name="box2"))
    with pytest.raises(Refused, match="no object 'bix' was added; known: box2, box1"):
        sim.things.remove("bix")


def test_the_number_of_obstacles_is_limited_and_removed_ones_are_reused() -> None:
    sim = simulation()
    names = [sim.things.add(Thing(x=2, y=-2 + n / 4)).name for n in range(12)]
    with pytest.raises(Refused, match="no box is left"):
        sim.things.add(Thing(x=-2))
    for _ in range(30):
        sim.things.remove(names.pop())
        names.append(sim.things.add(Thing(kind="cylinder", x=2)).name)
    people = [sim.things.add(Thing(kind="person", x=-2, y=n)).name for n in (-1, 0, 1, 2)]
    with pytest.raises(Refused, match="no person is left"):
        sim.things.add(Thing(kind="person", x=2))
    for name in (*names, *people):
        sim.things.remove(name)
    assert np.isfinite(sim.scan()[[0, 90, 180, 270]]).all()


def count_shapes(scene: SimScene, kind: int) -> int:
    return scene.kinds.count(kind)


def test_viewers_get_the_scene_and_the_poses_of_moving_bodies() -> None:
    sim = simulation()
    live = LiveWorld(sim, "room")
    (_, scene), (_, poses) = live.scene()
    assert isinstance(scene, SimScene)
    assert isinstance(poses, SimPoses)
    assert "robot/base" in scene.bodies
    assert not any(name.startswith("spare/") for name in scene.bodies)
    assert len(poses.poses) == 28 * (len(scene.bodies) - 1)
    place = np.frombuffer(poses.poses, "<f4").reshape(-1, 7)[scene.bodies.index("robot/base") - 1]
    assert place[:2] == pytest.approx((0.064, 0), abs=1e-4)
    boxes = count_shapes(scene, 1)
    sim.things.add(Thing(x=1, name="crate"))
    (_, scene), _ = live.scene()
    assert isinstance(scene, SimScene)
    assert count_shapes(scene, 1) == boxes + 1
    assert [thing.name for thing in scene.things] == ["crate"]
    assert "crate" in scene.bodies
    sim.things.remove("crate")
    (_, scene), _ = live.scene()
    assert isinstance(scene, SimScene)
    assert count_shapes(scene, 1) == boxes


def test_poses_are_sent_ten_times_a_second_and_the_scene_when_it_changes() -> None:
    sim = simulation()
    live = LiveWorld(sim, "room")
    sent_types = []
    for step in range(100):
        sim.advance()
        if step == 50:
            sim.things.add(Thing(x=1))
        sent_types += [type(message).__name__ for _, message in live.step()]
    assert sent_types.count("SimScene") == 2  # at the first step and at the change
    assert sent_types.count("SimPoses") == 12
