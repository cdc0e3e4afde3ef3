"""The true record of a run: contacts, clearance and falls; persons keep their distance."""

from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import pytest

from gigabrain_drivers.sim.body import SimBody
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.world import Box, Shape, WalkingPath, World


def waffle() -> SimBody:
    model = files("gigabrain_drivers") / "bodies/turtlebot3_waffle/model.xml"
    return SimBody(model=model.read_text(), wheel_radius=0.033, wheel_separation=0.287)


def room(*shapes: Shape) -> World:
    return World(name="room", description="", half_x=5.0, half_y=5.0, shapes=shapes)


def run(simulation: Simulation, seconds: float) -> None:
    for _ in range(round(seconds * 100)):
        simulation.advance()


def test_pushing_against_a_wall_is_one_contact_and_sets_the_bumper() -> None:
    simulation = Simulation(waffle(), room(Box(0.6, 0, 0.1, 1, 0.5)), 0)
    assert simulation.truth.min_clearance_m == pytest.approx(0.5 - 0.069, abs=1e-3)
    simulation.command(0.2, 0.0)
    run(simulation, 1)
    assert (simulation.truth.contacts, simulation.bumper()) == (0, False)
    run(simulation, 4)
    assert (simulation.truth.contacts, simulation.bumper()) == (1, True)
    assert simulation.truth.min_clearance_m == 0.0
    assert simulation.odometry().x > simulation.truth.pose().x + 0.05


def test_backing_off_and_touching_again_is_a_second_contact() -> None:
    simulation = Simulation(waffle(), room(Box(0.3, 0, 0.1, 1, 0.5)), 0)
    for speed in (0.2, -0.2, 0.2, 0.2):
        simulation.command(speed, 0.0)
        run(simulation, 1.5)
    assert simulation.truth.contacts == 2


def test_clearance_of_a_close_pass_is_exact_and_no_contact() -> None:
    simulation = Simulation(waffle(), room(Box(1.0, 0.3035, 0.1, 0.1, 0.5)), 0)
    simulation.command(0.26, 0.0)
    run(simulation, 6)
    assert simulation.truth.contacts == 0
    assert simulation.truth.min_clearance_m == pytest.approx(0.05, abs=2e-3)


def test_hitting_a_person_is_a_contact_but_persons_keep_half_a_metre() -> None:
    path = ((3.0, 0.0), (-3.0, 0.0), (-3.0, 3.0), (3.0, 3.0))
    world = replace(room(), people=(WalkingPath(path),))
    standing = Simulation(waffle(), world, 0)
    run(standing, 5)
    assert standing.truth.contacts == 0
    assert standing.truth.min_clearance_m == pytest.approx(0.5, abs=0.01)
    standing.command(0.2, 0.0)
    run(standing, 4)
    assert standing.truth.contacts == 1


def with_pit(folder: Path, depth: float) -> World:
    """Return a world whose floor continues lower from half a metre ahead."""
    path = folder / "pit.xml"
    path.write_text(
        "<mujoco><worldbody>"
        '<geom name="floor0" type="box" size="2.5 2.5 .5" pos="-2 0 -.5"/>'
        f'<geom name="floor1" type="box" size="2.5 2.5 .5" pos="3 0 {-0.5 - depth}"/>'
        "</worldbody></mujoco>"
    )
    return replace(room(), model=path)


@pytest.mark.parametrize("depth", [0.05, 0.3])
def test_a_fall_down_a_step_is_counted_once_and_is_no_contact(tmp_path: Path, depth: float) -> None:
    simulation = Simulation(waffle(), with_pit(tmp_path, depth), 0)
    simulation.command(0.2, 0.0)
    run(simulation, 1.5)
    assert simulation.truth.falls == 0
    run(simulation, 4)
    assert (simulation.truth.falls, simulation.truth.contacts) == (1, 0)


def test_hard_driving_and_braking_is_no_fall() -> None:
    simulation = Simulation(waffle(), room(), 0)
    for speed in (0.26, -0.26, 0.26, 0.0):
        simulation.command(speed, 1.8)
        run(simulation, 1)
    assert simulation.truth.falls == 0
