"""An arm in MuJoCo: it goes to its targets, holds still, and falls only when limp."""

from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.body import MujocoOptions, sim_body
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.joints import JointMotion, accelerated, stopped
from gigabrain_zenoh.qa.bench.hands import with_backlash

HOME = (0.0, -1.7, 1.4, 0.6, 0.0, 0.0)
NAMES = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
OUTSTRETCHED = (-0.8, 0.4, -0.8, -0.5, 0.0, 0.0)
MAX_SAG_RAD = 0.03  # [rad], of a servo without integral gain


def make_so101() -> Driver:
    _, driver = catalog.make_driver("so101", Run(folder=Path(), world="arena", speed=50.0))
    return driver


async def run_ticks(
    driver: Driver, ticks: AsyncIterator[int], count: int, act: Callable[[], Awaitable[object]]
) -> RobotState:
    for _ in range(count):
        await act()
        await anext(ticks)
    return await driver.read_state()


async def test_it_starts_in_its_home_posture_and_reaches_its_targets() -> None:
    driver = make_so101()
    goal = dict(zip(NAMES, (0.5, -0.5, 0.6, 0.4, 1.0, 0.8), strict=True))

    async def aim() -> None:
        assert await driver.set_joint_positions(goal) == goal

    async with driver:
        ticks = driver.ticks(Clock())
        state = await run_ticks(driver, ticks, 50, driver.stop)
        assert tuple(joint.name for joint in state.joints) == NAMES
        assert [j.position for j in state.joints] == pytest.approx(HOME, abs=MAX_SAG_RAD)
        state = await run_ticks(driver, ticks, 100, aim)
        assert [j.position for j in state.joints] == pytest.approx(
            list(goal.values()), abs=MAX_SAG_RAD
        )
        held = await run_ticks(driver, ticks, 50, driver.hold)
        assert [j.position for j in held.joints] == pytest.approx(
            [j.position for j in state.joints], abs=0.01
        )
        assert all(joint.effort is not None and joint.current is not None for joint in held.joints)
        assert not held.limp
        await ticks.aclose()  # type: ignore[attr-defined]
    assert driver.report()["falls"] == 0


async def test_a_limp_arm_falls_until_it_gets_new_targets() -> None:
    driver = make_so101()

    async def nothing() -> None: ...

    async with driver:
        ticks = driver.ticks(Clock())
        stretched = dict(zip(NAMES, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), strict=True))
        await run_ticks(driver, ticks, 100, lambda: driver.set_joint_positions(stretched))
        await driver.limp()
        state = await run_ticks(driver, ticks, 100, nothing)
        assert state.limp
        assert state.joints[2].position > 0.2
        where = {joint.name: joint.position for joint in state.joints}
        state = await run_ticks(driver, ticks, 20, lambda: driver.set_joint_positions(where))
        assert not state.limp
        assert state.joints[2].position == pytest.approx(where["elbow_flex"], abs=MAX_SAG_RAD)
        await ticks.aclose()  # type: ignore[attr-defined]


def test_the_brain_gets_its_model_as_text() -> None:
    model = make_so101().arm_model()
    assert model
    assert "<mujoco" in model.mjcf


def simulation_of(body: str, backlash: float = 0.0) -> Simulation:
    robot, _, options, folder = catalog.load_link(body, Run(folder=Path()))
    assert isinstance(options, MujocoOptions)
    model = with_backlash(sim_body(robot, options, Run(folder=folder)), backlash)
    return Simulation(model, load_world("table", 0), 0)


@pytest.mark.slow
def test_an_outstretched_piper_holds_its_payload_without_overheating() -> None:
    simulation, limit = simulation_of("piper"), catalog.load_robot("piper").thresholds.motor_stop
    assert simulation.arm
    hand = simulation.model.body("robot/link6").id
    simulation.model.body_mass[hand] += 1.5
    simulation.arm.aim({"joint1": 0.0, "joint2": 2.2, "joint3": -2.2, "joint5": 0.0})
    for _ in range(300):
        simulation.advance()
    motors = simulation.arm.motors()
    assert abs(motors[1].effort) > 15.0
    for _ in range(360_000):  # an hour
        simulation.arm.wear()
    assert 40.0 < max(motor.temperature for motor in simulation.arm.motors()) < limit


def test_a_smoothed_servo_follows_a_moving_target_without_torque_peaks() -> None:
    simulation = simulation_of("piper")
    assert simulation.arm
    data, joint = simulation.data, simulation.model.actuator("robot/joint1").id
    efforts, speeds = [], []
    for number in range(50):
        simulation.arm.aim({"joint1": 0.02 * number})  # 1 rad/s, as control sends it
        for _ in range(10):
            simulation.arm.act()
            mujoco.mj_step(simulation.model, data)
            efforts.append(abs(data.actuator_force[joint]))
            speeds.append(data.joint("robot/joint1").qvel[0])
    assert np.mean(speeds[250:]) == pytest.approx(1.0, rel=0.05)
    assert max(efforts[250:]) < 25.0  # [N m], of at most 40


OUTSTRETCHED_JOINTS = {
    "so101": {"shoulder_lift": 0.3, "elbow_flex": -0.3, "wrist_flex": 0.0},
    "piper": {"joint2": 1.6, "joint3": -1.3},
}


@pytest.mark.parametrize("body", OUTSTRETCHED_JOINTS)
def test_a_joint_moves_freely_within_its_backlash_and_sags_to_its_end(body: str) -> None:
    rests = {}
    for play in (0.0, 0.04):
        simulation = simulation_of(body, play)
        assert simulation.arm
        simulation.arm.aim(OUTSTRETCHED_JOINTS[body])
        for _ in range(300):
            simulation.advance()
        rests[play] = [motor.position for motor in simulation.arm.motors()]
        pan = simulation.model.joint(f"robot/{simulation.arm.names[0]}")
        simulation.data.qpos[pan.qposadr[0]] += 0.015
        simulation.data.qvel[:] = 0.0
        for _ in range(100):
            simulation.advance()
        back = simulation.arm.motors()[0].position - rests[play][0]
        assert back == pytest.approx(0.015 if play else 0.0, abs=0.006)
    sagged = np.abs(np.subtract(rests[0.04], rests[0.0]))
    assert sagged[1:3] == pytest.approx([0.02, 0.02], abs=0.004)


def test_servos_of_an_unknown_joint_are_refused_with_their_line(tmp_path: Path) -> None:
    path = catalog.robot_path("piper")
    mine = tmp_path / "robot.yaml"
    mine.write_text(path.read_text().replace("joints: [gripper]", "joints: [griper]"))
    (tmp_path / "model.xml").write_text(path.with_name("model.xml").read_text())
    with pytest.raises(ConfigError, match=r":\d+: no joint 'griper'; did you mean 'gripper'"):
        catalog.make_driver(str(mine), Run(folder=Path()))


@pytest.mark.parametrize("name", NAMES[:5])
async def test_a_joint_at_its_maximum_speed_rests_120_ms_after_a_stop(
    name: str,
) -> None:
    robot, driver = catalog.make_driver("so101", Run(folder=Path(), world="arena", speed=50.0))
    index = NAMES.index(name)
    joint = robot.joints[index]
    posture = dict(zip(NAMES, OUTSTRETCHED, strict=True))
    sent = JointMotion(posture[name])

    async def aim() -> None:
        await driver.set_joint_positions(posture | {name: sent.position})

    async with driver:
        ticks = driver.ticks(Clock())
        await run_ticks(driver, ticks, 100, aim)
        for _ in range(18):
            sent = accelerated(sent, joint.max_speed, joint, 0.02)
            state = await run_ticks(driver, ticks, 1, aim)
        assert state.joints[index].velocity > 0.9 * joint.max_speed
        sent = stopped(sent)
        await run_ticks(driver, ticks, 6, aim)
        for _ in range(25):
            state = await run_ticks(driver, ticks, 1, aim)
            assert abs(state.joints[index].velocity) < 0.2
        await ticks.aclose()  # type: ignore[attr-defined]
