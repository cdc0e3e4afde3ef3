"""Obstacles and people that are put into a running simulation."""

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


def run(one: Simulation, seconds: float) -> None:
    for _ in range(round(seconds * 100)):
        one.advance()


@pytest.mark.parametrize(("kind", "distance"), [("box", 0.9), ("cylinder", 0.9)])
def test_what_is_put_in_shows_in_the_next_scan(kind: str, distance: float) -> None:
    one = simulation()
    run(one, 0.1)
    assert one.scan()[0] == pytest.approx(3.0, abs=0.05)
    thing = one.things.add(Thing(kind=kind, x=1.0, size=(0.2, 0.2, 0.5)))  # type: ignore[arg-type]
    assert one.scan()[0] == pytest.approx(distance, abs=0.05)
    assert (one.scan()[[20, 340, 180]] > 2.5).all()
    one.things.remove(thing.name)
    assert one.scan()[0] == pytest.approx(3.0, abs=0.05)


def test_a_large_turned_box_has_its_whole_width_and_height() -> None:
    one = simulation()
    one.things.add(Thing(x=2.0, yaw=math.pi / 2, size=(4.0, 0.2, 0.3)))
    ranges = one.scan()
    assert ranges[0] == pytest.approx(1.9, abs=0.05)
    assert ranges[40] == pytest.approx(1.9 / math.cos(math.radians(40)), abs=0.06)


def test_the_robot_cannot_drive_through_it_and_touching_it_is_a_contact() -> None:
    one = simulation()
    one.things.add(Thing(x=0.8, size=(0.2, 1.0, 0.5)))
    one.command(0.2, 0.0)
    run(one, 8)
    assert one.truth.contacts == 1
    assert one.truth.pose().x < 0.8 - 0.1 - one.truth.footprint.front + 0.02


def test_a_removed_box_is_passed_through() -> None:
    one = simulation()
    one.things.add(Thing(x=0.8, size=(0.2, 1.0, 0.5), name="gate"))
    one.things.remove("gate")
    one.command(0.2, 0.0)
    run(one, 8)
    assert one.truth.contacts == 0
    assert one.truth.pose().x > 1.4


def test_a_person_walks_there_and_back_and_stops_for_the_robot() -> None:
    one = simulation()
    name = one.things.add(Thing(kind="person", x=2.0, y=-1.0, path=((2.0, 1.0),))).name
    body = one.model.body("spare/person0").mocapid[0]
    run(one, 1.0)
    assert one.data.mocap_pos[body][:2] == pytest.approx((2.0, -0.2), abs=0.01)
    run(one, 2.0)
    assert one.data.mocap_pos[body][:2] == pytest.approx((2.0, 0.6), abs=0.01)
    one.things.remove(name)
    one.things.add(Thing(kind="person", x=2.0, path=((-2.0, 0.0),)))
    run(one, 6.0)
    assert one.person_stood == 1
    assert one.truth.contacts == 0


def test_a_person_without_a_way_stands() -> None:
    one = simulation()
    one.things.add(Thing(kind="person", x=1.5))
    run(one, 1.0)
    assert one.scan()[0] == pytest.approx(1.25, abs=0.05)


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
def test_what_cannot_be_is_refused_and_leaves_nothing(thing: Thing, complaint: str) -> None:
    one = simulation(half=2.4)
    before = one.scan()
    with pytest.raises(Refused, match=complaint):
        one.things.add(thing)
    assert one.things.all() == ()
    assert one.scan() == pytest.approx(before, abs=0.1)
    run(one, 0.2)
    assert one.truth.contacts == 0


def test_names_are_numbered_and_taken_once() -> None:
    one = simulation()
    assert one.things.add(Thing(x=2)).name == "box1"
    assert one.things.add(Thing(x=2, y=1)).name == "box2"
    one.things.remove("box1")
    assert one.things.add(Thing(x=2)).name == "box1"
    with pytest.raises(Refused, match="there is a 'box2' already"):
        one.things.add(Thing(x=2, name="box2"))
    with pytest.raises(Refused, match="nothing called 'bix' was put in; there is: box2, box1"):
        one.things.remove("bix")


def test_the_spares_come_to_an_end_and_can_be_used_again() -> None:
    one = simulation()
    names = [one.things.add(Thing(x=2, y=-2 + n / 4)).name for n in range(12)]
    with pytest.raises(Refused, match="no box is left"):
        one.things.add(Thing(x=-2))
    for _ in range(30):
        one.things.remove(names.pop())
        names.append(one.things.add(Thing(kind="cylinder", x=2)).name)
    people = [one.things.add(Thing(kind="person", x=-2, y=n)).name for n in (-1, 0, 1, 2)]
    with pytest.raises(Refused, match="no person is left"):
        one.things.add(Thing(kind="person", x=2))
    for name in (*names, *people):
        one.things.remove(name)
    assert np.isfinite(one.scan()[[0, 90, 180, 270]]).all()


def shapes(scene: SimScene, kind: int) -> int:
    return scene.kinds.count(kind)


def test_viewers_get_the_scene_and_the_poses_of_what_moves() -> None:
    one = simulation()
    live = LiveWorld(one, "room")
    (_, scene), (_, poses) = live.scene()
    assert isinstance(scene, SimScene)
    assert isinstance(poses, SimPoses)
    assert "robot/base" in scene.bodies
    assert not any(name.startswith("spare/") for name in scene.bodies)
    assert len(poses.poses) == 28 * (len(scene.bodies) - 1)
    place = np.frombuffer(poses.poses, "<f4").reshape(-1, 7)[scene.bodies.index("robot/base") - 1]
    assert place[:2] == pytest.approx((0.064, 0), abs=1e-4)
    boxes = shapes(scene, 1)
    one.things.add(Thing(x=1, name="crate"))
    (_, scene), _ = live.scene()
    assert isinstance(scene, SimScene)
    assert shapes(scene, 1) == boxes + 1
    assert [thing.name for thing in scene.things] == ["crate"]
    assert "crate" in scene.bodies
    one.things.remove("crate")
    (_, scene), _ = live.scene()
    assert isinstance(scene, SimScene)
    assert shapes(scene, 1) == boxes


def test_poses_are_sent_ten_times_a_second_and_the_scene_when_it_changes() -> None:
    one = simulation()
    live = LiveWorld(one, "room")
    news = []
    for step in range(100):
        one.advance()
        if step == 50:
            one.things.add(Thing(x=1))
        news += [type(message).__name__ for _, message in live.step()]
    assert news.count("SimScene") == 2  # at its first step, and at the change
    assert news.count("SimPoses") == 12
