"""A hostile commander and an arm in MuJoCo: in the physics, the arm touches nothing."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import msgspec
import mujoco
import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_drivers.driver.catalog import load_robot, robot_path
from gigabrain_drivers.driver.process import commanded_joints
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.body import MujocoOptions, sim_body
from gigabrain_drivers.sim.driver import STEPS_PER_TICK, state_message
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.scene import ROBOT
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_schemas.body import BodyDescription, KeepOut
from gigabrain_schemas.brain import JointCommand
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.limits import ZERO, limits_of
from gigabrain_zenoh.safety.arm_shape import MujocoArm
from gigabrain_zenoh.safety.step import SafetyInputs, SafetyMemory, step

BOOT, LATE_TICKS = 7, 2  # delay of a verdict from safety to gate
BOXES = (
    KeepOut(name="shelf", center=(0.32, 0.12, 0.22), size=(0.1, 0.2, 0.02), yaw=0.3),
    KeepOut(name="post", center=(0.15, -0.22, 0.15), size=(0.04, 0.04, 0.3)),
)
FOLDER = robot_path("so101").parent
MJCF = (FOLDER / "model.xml").read_text()
REST_SPEED_RAD_S = 0.05  # [rad/s]


class Truth:
    """A second model with the arm, floor and boxes, set to the posture of the physics."""

    def __init__(self, body: BodyDescription) -> None:
        spec = mujoco.MjSpec.from_string(MJCF)
        solid = {"contype": -1, "conaffinity": -1}
        spec.worldbody.add_geom(
            name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1], **solid
        )
        assert body.arm
        for box in body.arm.keep_out:
            turn = [np.cos(box.yaw / 2), 0, 0, np.sin(box.yaw / 2)]
            half = [side / 2 for side in box.size]
            spec.worldbody.add_geom(
                name=box.name, type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=box.center, quat=turn,
                **solid,
            )  # fmt: skip
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        chain = ["base", "shoulder", "upper_arm", "lower_arm", "wrist", "gripper", "jaw"]
        self._neighbours = {frozenset(pair) for pair in pairwise(chain)}

    def touching(self, posture: NDArray[np.float64]) -> set[tuple[str, str]]:
        """Return the forbidden pairs of bodies that are in contact."""
        self.data.qpos[:] = posture
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        found = set()
        for contact in self.data.contact:
            a, b = (self._name(geom) for geom in contact.geom)
            still = {a, b} <= {"base", "table", "shelf", "post"}
            if contact.dist < 0 and not still and frozenset((a, b)) not in self._neighbours:
                found.add((a, b))
        return found

    def _name(self, geom: int) -> str:
        body = self.model.geom_bodyid[geom]
        return str(self.model.body(body).name if body else self.model.geom(geom).name)


class Rig:
    """The physics, gate and safety of an arm, stepped by ticks with or without a command."""

    def __init__(self) -> None:
        robot = load_robot("so101")
        assert robot.sim
        assert robot.arm
        self.body = replace(robot.description(), arm=replace(robot.arm, floor=0.0, keep_out=BOXES))
        options = msgspec.convert(robot.sim, MujocoOptions)
        self.simulation = Simulation(
            sim_body(robot, options, Run(folder=FOLDER)), load_world("arena", 0), 0
        )
        assert self.simulation.arm
        self.arm = self.simulation.arm
        self.truth, self.touched = Truth(self.body), set[tuple[str, str]]()
        self.config = gate.GateConfig(limits=limits_of(self.body), joints=self.body.joints)
        self.gate = gate.GateState(boot=BOOT)
        self.memory, self.shape = SafetyMemory(), MujocoArm(MJCF, self.body)
        self.verdicts: list[gate.Safety] = []
        self.names = tuple(joint.name for joint in self.body.joints)
        self.cause_codes: set[str] = set()
        self.safety_alive = True
        for _ in range(60):
            self.tick()
        assert self.feed(gate.Release(0)).ok
        assert self.feed(gate.Enable("script")).ok

    def feed(self, event: gate.Event) -> gate.Outcome:
        self.gate, outcome = gate.step(self.config, self.gate, event)
        return outcome

    @property
    def posture(self) -> NDArray[np.float64]:
        """Return the joint angles of the physics, not of their encoders [rad]."""
        return np.array([self._joint(name).qpos[0] for name in self.names])

    @property
    def speeds(self) -> NDArray[np.float64]:
        """Return the joint speeds of the physics [rad/s]."""
        return np.array([self._joint(name).qvel[0] for name in self.names])

    def _joint(self, name: str) -> Any:
        return self.simulation.data.joint(f"{ROBOT}{name}")

    def tick(self, **command: tuple[float, ...]) -> None:
        state = state_message(self.simulation, "so101")
        now = commanded_joints(self.body, state)
        self.feed(gate.Tick(ZERO, joints=now))
        tick = self.gate.tick
        state = replace(state, boot=BOOT, tick=tick, gate=gate.status(self.gate), bumpers=())
        if self.safety_alive:
            self.memory, verdict = step(
                self.body, self.memory, SafetyInputs(state=state, arm=self.shape)
            )
            self.cause_codes |= {cause.code for cause in verdict.causes}
            self.verdicts.append(gate.Safety(replace(verdict, boot=BOOT, tick=tick)))
        if self.verdicts and self.verdicts[0].state.tick <= tick - LATE_TICKS:
            self.feed(self.verdicts.pop(0))
        if command:
            message = JointCommand(
                name=self.names, source="script", boot=BOOT, tick=tick, seq=tick, **command
            )
            self.feed(gate.JointsCommand(message))
        self.arm.aim({n: m.position for n, m in zip(self.names, self.gate.joints, strict=True)})
        for _ in range(STEPS_PER_TICK):
            self.simulation.advance()
            self.touched |= self.truth.touching(self.posture)


def attack(rig: Rig, targets: int, seed: int) -> None:
    """Send the arm to random postures without a pause, by positions or by 3 rad/s."""
    rng = np.random.default_rng(seed)
    lower, upper = np.array([(joint.lower, joint.upper) for joint in rig.body.joints]).T
    for _ in range(targets):
        target = rng.uniform(lower, upper)
        by_speed = rng.random() < 0.3
        for _ in range(int(rng.integers(5, 60))):
            if by_speed:
                way = np.where(target > rig.posture, 3.0, -3.0)
                rig.tick(velocity=tuple(way.tolist()))
            else:
                rig.tick(position=tuple(target.tolist()))
        assert not rig.touched, f"at tick {rig.gate.tick}"
        assert rig.gate.mode == "enabled", rig.gate.causes


@pytest.mark.parametrize(
    ("seed", "targets"),
    [
        (1, 20),
        pytest.param(1, 100, marks=pytest.mark.slow),
        pytest.param(2, 100, marks=pytest.mark.slow),
    ],
)
def test_a_hostile_commander_cannot_make_the_arm_touch_anything(seed: int, targets: int) -> None:
    rig = Rig()
    attack(rig, targets, seed)
    assert rig.cause_codes & {"arm_self", "arm_floor", "arm_keep_out"}


def rests_for(rig: Rig, code: str, posture: tuple[float, ...]) -> bool:
    """Command a posture for one tick, and return whether the arm rests for this cause."""
    rig.tick(position=posture)
    causes = rig.gate.safety.causes if rig.gate.safety else ()
    return code in [cause.code for cause in causes] and bool(
        np.abs(rig.speeds).max() < REST_SPEED_RAD_S
    )


@pytest.mark.parametrize(
    ("posture", "code"),
    [
        ((0.0, 0.9, 0.9, 0.9, 0.0, 0.0), "arm_floor"),
        ((0.0, -1.7, 1.69, 1.65, 0.0, 0.0), "arm_self"),
        ((1.1, 0.8, 0.3, 0.0, 0.0, 0.0), "arm_keep_out"),
    ],
)
def test_it_stops_before_contact_names_the_cause_and_can_go_back(
    posture: tuple[float, ...], code: str
) -> None:
    rig = Rig()
    assert rig.body.arm
    start = rig.body.arm.home
    assert any(rests_for(rig, code, posture) for _ in range(250))
    assert rig.gate.mode == "enabled"
    for _ in range(150):
        rig.tick(position=start)
    assert rig.posture == pytest.approx(np.array(start), abs=0.1)
    assert not rig.touched


def press(rig: Rig) -> None:
    rig.feed(gate.Estop("somebody"))


def end_commands(_: Rig) -> None:
    """Do nothing: the test sends no more commands."""


def kill_safety(rig: Rig) -> None:
    rig.safety_alive = False
    rig.verdicts.clear()


@pytest.mark.parametrize(("end", "ticks"), [(press, 1), (kill_safety, 12), (end_commands, 9)])
def test_an_estop_or_a_dead_process_holds_a_moving_arm(
    end: Callable[[Rig], None], ticks: int
) -> None:
    """The targets stay after `ticks` ticks, and the arm sags by less than 2 degrees.

    Until then a servo may swing as its own damping lets it; the gate has no part in that.
    """
    rig = Rig()
    outstretched = (0.0, 0.0, 0.3, 0.0, 0.0, 0.0)
    for _ in range(22):
        rig.tick(position=outstretched)
    assert np.abs(rig.speeds).max() > 1.0
    end(rig)
    for _ in range(ticks):
        rig.tick(**({"position": outstretched} if end is kill_safety else {}))
    assert [joint.velocity for joint in rig.gate.joints] == [0.0] * 6
    sent = [joint.position for joint in rig.gate.joints]
    for _ in range(75):
        rig.tick()
    held = rig.posture
    assert np.abs(rig.speeds).max() < REST_SPEED_RAD_S
    for _ in range(100):
        rig.tick()
    assert [joint.position for joint in rig.gate.joints] == sent
    assert np.degrees(np.abs(rig.posture - held)).max() < 2.0
    assert rig.gate.mode != "enabled"
    assert not rig.touched


def test_no_jaw_or_roll_angle_brings_the_jaw_near_the_wrist() -> None:
    body = load_robot("so101").description()
    shape = MujocoArm(MJCF, body)
    names = [joint.name for joint in body.joints]
    assert body.arm
    rolls = [np.array(body.arm.home) for _ in range(200)]
    random = np.random.default_rng(1)
    for posture in rolls:
        for name in ("wrist_roll", "gripper"):
            joint = body.joints[names.index(name)]
            posture[names.index(name)] = random.uniform(joint.lower, joint.upper)
    everything = np.full((len(rolls), len(shape.levers)), 0.03)
    near = shape.near(np.array(rolls), everything)
    kinds = {frozenset(shape.describe(int(pair))[1:]) for pair in near.pairs}
    assert {"wrist", "jaw"} not in kinds
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    geoms = [
        [geom for geom in range(model.ngeom) if model.body(model.geom_bodyid[geom]).name == name]
        for name in ("wrist", "jaw")
    ]
    for posture in rolls:
        for name, place in zip(names, posture, strict=True):
            data.joint(name).qpos = place
        mujoco.mj_kinematics(model, data)
        apart = [
            mujoco.mj_geomDistance(model, data, a, b, 1.0, None) for a in geoms[0] for b in geoms[1]
        ]
        assert min(apart) > 0.004
