"""`gigabrain bench hands`: an arm picks things up and puts them down; the physics judge it.

Planner, control and gate are the same as on a robot; they run in memory on a simulated body.
"""

import dataclasses
import math
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from msgspec import Struct

from gigabrain_drivers.driver.catalog import load_link
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_drivers.sim.body import MujocoOptions, SimModel, SimServo, sim_body
from gigabrain_drivers.sim.driver import state_message
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import Intent
from gigabrain_schemas.safety import JointCap, SafetyState
from gigabrain_zenoh.control.joints import JointInputs, JointMemory, step_joints
from gigabrain_zenoh.decision.held_things import floor_of, thing_of
from gigabrain_zenoh.decision.manipulator import TRIES
from gigabrain_zenoh.decision.seen_things import Lookout, located
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.geometry.joints import JointMotion
from gigabrain_zenoh.geometry.limits import ZERO, limits_of
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.manipulation.arm_planner import ArmPlanner, Hold, Plan
from gigabrain_zenoh.manipulation.collision import Thing
from gigabrain_zenoh.manipulation.phases import Phase, PhaseRun
from gigabrain_zenoh.manipulation.pick_place import NoWay

if TYPE_CHECKING:
    from gigabrain_zenoh.qa.bench.hands_camera import ArmCamera

KINDS = ("cube", "cylinder", "sphere")
SIZES_M, MASSES_KG, FRICTIONS = (0.02, 0.04), (0.02, 0.08, 0.2), (0.4, 1.0)
REACH_M, AROUND_RAD = (0.10, 0.26), math.pi / 2  # distance from the first joint's axis, and angle
TALL = 1.2  # length over diameter of a cylinder
LIFTED_M = 0.01  # least height of a thing that counts as picked up
PLACED_M = 0.01  # largest error of a thing that counts as placed
SETTLE_TICKS = 25
TARGETS = 20  # largest number of places to try
FRICTION_2_3 = "0.02 0.0005"  # torsional and rolling friction of things
SLACK = 0.001  # share of a joint's range, or of its speed, by which it may exceed its limits
Progress = Callable[[str], None]


class HandsRun(Struct, frozen=True, kw_only=True):
    """The result with one thing."""

    seed: int
    kind: str
    size_m: float
    mass_kg: float
    friction: float
    distance_m: float  # from the first joint's axis
    outcome: str  # "placed", "unreachable", or the kind of failure
    reason: str = ""
    off_m: float | None = None  # true distance from its target
    seconds: float = 0.0  # of the robot's time
    planning_s: float = 0.0  # wall time
    fastest: float = 0.0  # highest true speed of a joint, as a share of its limit
    broken_limits: int = 0  # ticks with a joint beyond its range or speed, by the physics
    seen_off_m: float | None = None  # error of the position that was seen last


class HandsResult(Struct, frozen=True, kw_only=True):
    """The results with all things."""

    body: str
    backlash_deg: float = 0.0
    runs: tuple[HandsRun, ...]
    camera: bool = False  # things were found by a camera


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """A thing on the table."""

    kind: str
    size: float  # [m], edge or diameter
    mass: float  # [kg]
    friction: float
    distance: float  # [m]
    x: float  # [m], in the frame of the arm's base
    y: float  # [m]
    yaw: float  # [rad]

    @property
    def height(self) -> float:
        """Height of its middle above the table [m]."""
        return self.size * (TALL if self.kind == "cylinder" else 1.0) / 2

    def thing(self) -> Thing:
        """Return it for the planner."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        radius, tall = self.size / 2, 2 * self.height
        sizes = {"cube": (self.size,) * 3, "cylinder": (radius, tall), "sphere": (radius,)}
        return Thing(
            name="the thing",
            kind="box" if self.kind == "cube" else "cylinder" if tall > self.size else "sphere",
            size=sizes[self.kind],
            position=np.array([self.x, self.y, self.height]),
            axes=np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]),
        )

    def mjcf(self) -> str:
        """Return it on a floor, as an MJCF model."""
        half = self.size / 2
        sizes = {"cube": (half,) * 3, "cylinder": (half, self.height), "sphere": (half,)}
        kind = "box" if self.kind == "cube" else self.kind
        size = " ".join(f"{one:g}" for one in sizes[self.kind])
        yaw = math.degrees(self.yaw)
        return f"""<mujoco><worldbody>
          <geom name="floor" type="plane" size="2 2 .1"/>
          <body name="thing" pos="{self.x} {self.y} {self.height}" euler="0 0 {yaw}">
            <freejoint/>
            <geom type="{kind}" size="{size}" mass="{self.mass}" condim="6"
              friction="{self.friction} {FRICTION_2_3}"/>
          </body></worldbody></mujoco>"""


def draw(rng: np.random.Generator, pan: float) -> Drawn:
    """Draw a thing on the table; `pan` is the x of the first joint's axis [m]."""
    distance = float(rng.uniform(*REACH_M))
    angle = float(rng.uniform(-AROUND_RAD, AROUND_RAD))
    return Drawn(
        kind=str(rng.choice(KINDS)),
        size=float(rng.uniform(*SIZES_M)),
        mass=float(rng.choice(MASSES_KG)),
        friction=float(rng.choice(FRICTIONS)),
        distance=distance,
        x=pan + distance * math.cos(angle),
        y=distance * math.sin(angle),
        yaw=float(rng.uniform(-math.pi, math.pi)),
    )


def pan_axis(arm: ArmKinematics) -> float:
    """Return the x of the first joint's axis [m]."""
    return float(arm.chain.fixed[0, 0, 3])


class ArmInMemory:
    """A simulated arm behind the gate, with control. The caller is the brain."""

    def __init__(self, robot: RobotFile, body: SimModel, world: Path) -> None:
        self.robot, self.description = robot, robot.description()
        self.simulation = Simulation(body, load_world(str(world), 0), 0)
        assert self.simulation.arm
        self.arm = self.simulation.arm
        self._gate_config = gate.GateConfig(
            limits=limits_of(self.description), joints=self.description.joints, auto_resume=True
        )
        self._gate, self._memory, self._seq = gate.GateState(boot=1), JointMemory(), 0
        self.broken, self.ticks, self.fastest = 0, 0, 0.0
        self.caps: tuple[JointCap, ...] = ()  # set by safety
        while self._gate.mode != "enabled":
            self.step(Intent(behaviour="hands", reason="waiting"))

    def state(self) -> RobotState:
        """Return the state as the driver publishes it."""
        state = state_message(self.simulation, self.robot.robot_type)
        return msgspec.structs.replace(
            state, boot=1, tick=self._gate.tick, gate=gate.status(self._gate)
        )

    def step(self, intent: Intent) -> None:
        """Step 20 ms: gate, control, gate, servos, physics."""
        state = self.state()
        joints = tuple(JointMotion(joint.position, joint.velocity) for joint in state.joints)
        self._feed(gate.Tick(ZERO, joints=joints, held=state.joints_sent))
        self._feed(
            gate.Safety(SafetyState(verdict="ok", joints=self.caps, boot=1, tick=self._gate.tick))
        )
        self._memory, command = step_joints(
            self.description, self._memory, JointInputs(state=self.state(), intent=intent)
        )
        if command:
            self._seq += 1
            header = {"boot": 1, "tick": self._gate.tick, "basis": self._gate.tick}
            command = msgspec.structs.replace(command, seq=self._seq, source=BRAIN, **header)
            self._feed(gate.JointsCommand(command))
        names = [joint.name for joint in self.description.joints]
        wanted = (joint.position for joint in self._gate.joints)
        self.arm.aim(dict(zip(names, wanted, strict=True)))
        for _ in range(2):
            self.simulation.advance()
        self.ticks += 1
        self.broken += self._breaks_limits()

    def carry_out(self, phase: Phase) -> None:
        """Execute one phase of a plan."""
        run = PhaseRun([phase], self.description.joints[-1].name, self._gate.tick)
        while not run.advance(self._gate.tick):
            joints, window = run.wish(self._gate.tick)
            self.step(
                Intent(joints=joints, joint_trajectory=window, behaviour="hands", reason=phase.name)
            )

    def carry_out_all(self, phases: Sequence[Phase]) -> None:
        """Execute the phases of a plan."""
        for phase in phases:
            self.carry_out(phase)

    def settle(self) -> None:
        """Wait at rest for SETTLE_TICKS."""
        for _ in range(SETTLE_TICKS):
            self.step(Intent(behaviour="hands", reason="done"))

    def posture(self, names: Sequence[str]) -> Floats:
        """Return the newest goals of some joints [rad] or [m]."""
        sent = dict(zip(self.arm.names, self.arm.targets, strict=True))
        return np.array([sent[name] for name in names])

    def measured(self, name: str) -> float:
        """Return the measured position of a joint [rad] or [m]."""
        return next(motor.position for motor in self.arm.motors() if motor.name == name)

    def thing(self) -> Floats:
        """Return the true position of the thing (3,) [m]."""
        model, data = self.simulation.model, self.simulation.data
        return np.array(data.xpos[model.body("world/thing").id])

    def _feed(self, event: gate.Event) -> None:
        self._gate, _ = gate.step(self._gate_config, self._gate, event)

    def _breaks_limits(self) -> bool:
        """Return whether a joint truly breaks a limit; record the highest speed."""
        broken = False
        for joint, position, speed in zip(self.description.joints, *self.arm.truth(), strict=True):
            slack, share = SLACK * (joint.upper - joint.lower), abs(speed) / joint.max_speed
            self.fastest = max(self.fastest, share)
            within = joint.lower - slack <= position <= joint.upper + slack and share <= 1 + SLACK
            broken = broken or not within
        return broken


def arm_before(drawn: Drawn, robot: RobotFile, model: SimModel) -> ArmInMemory:
    """Return an arm with a thing on a table in front of it."""
    with tempfile.TemporaryDirectory(prefix="gigabrain-") as folder:
        (Path(folder) / "thing.xml").write_text(drawn.mjcf())
        world = Path(folder) / "world.yaml"
        world.write_text("model: thing.xml\nstart: [0.0, 0.0, 0.0]\n")
        return ArmInMemory(robot, model, world)


def with_backlash(model: SimModel, backlash: float) -> SimModel:
    """Return a body with `backlash` [rad] in its turning joints."""
    servos = {
        joint.name: msgspec.structs.replace(
            model.servos.get(joint.name, SimServo()), backlash=backlash
        )
        for joint in model.joints
        if joint.unit == "rad"
    }
    return dataclasses.replace(model, servos={**model.servos, **servos})


def measure_hands(
    seeds: Sequence[int],
    body: str,
    show: Progress,
    *,
    backlash_deg: float = 0.0,
    camera: bool = False,
) -> HandsResult:
    """Let an arm pick up one thing for each seed, and put it down elsewhere.

    With `camera`, its first camera finds the thing. Raises ConfigError for a body without an arm in
    MuJoCo, or without a camera.
    """
    robot, _, options, folder = load_link(body, Run(folder=Path(), cameras=camera))
    if robot.arm is None or not isinstance(options, MujocoOptions):
        raise ConfigError(f"{body} has no arm in MuJoCo; choose so101 or piper")
    if camera and not robot.cameras:
        raise ConfigError(f"{body} has no camera; choose so101")
    model = sim_body(robot, options, Run(folder=folder))
    model = with_backlash(model, math.radians(backlash_deg))
    runs = []
    for seed in seeds:
        runs.append(_run(seed, robot, model))
        show(in_words(runs[-1]))
    return HandsResult(body=body, backlash_deg=backlash_deg, camera=camera, runs=tuple(runs))


def in_words(run: HandsRun) -> str:
    """Return the result with one thing as text."""
    what = f"{run.kind} {run.size_m * 100:.1f} cm, {run.mass_kg * 1000:.0f} g"
    where = f"{run.distance_m * 100:.0f} cm away"
    off = "" if run.off_m is None else f", {run.off_m * 100:.1f} cm off"
    return f"{run.seed}: {what}, {where}: {run.outcome}{off}{f': {run.reason}' * bool(run.reason)}"


@dataclass
class Attempt:
    """The outcome of picking up one thing and putting it down."""

    outcome: str = ""
    reason: str = ""
    target: Floats | None = None  # (3,) [m], where it was put down
    planning_s: float = 0.0
    seen_off: float | None = None  # [m]

    def end(self, outcome: str, reason: str = "") -> None:
        """Record the outcome."""
        self.outcome, self.reason = outcome, reason


def _run(seed: int, robot: RobotFile, model: SimModel) -> HandsRun:
    rng = np.random.default_rng(seed)
    planner = ArmPlanner(model.model, robot.description())
    drawn = draw(rng, pan_axis(planner.arm))
    arm = arm_before(drawn, robot, model)
    attempt = Attempt()
    if robot.cameras:
        from gigabrain_zenoh.qa.bench.hands_camera import ArmCamera  # imports OpenCV

        with closing(ArmCamera(arm.description, model.model, arm.simulation, seed)) as camera:
            look = partial(_find_thing, arm, planner, camera)
            _pick_and_place(arm, planner, look, drawn, rng, attempt)
    else:
        _pick_and_place(arm, planner, drawn.thing, drawn, rng, attempt)
    off = None
    if attempt.target is not None:
        off = float(np.hypot(*(arm.thing()[:2] - attempt.target[:2])))
        attempt.outcome = "placed" if off <= PLACED_M else "misplaced"
    return HandsRun(
        seed=seed, kind=drawn.kind, size_m=drawn.size, mass_kg=drawn.mass,
        friction=drawn.friction, distance_m=drawn.distance, outcome=attempt.outcome,
        reason=attempt.reason, off_m=off, seconds=arm.ticks * TICK_S,
        planning_s=attempt.planning_s, fastest=arm.fastest, broken_limits=arm.broken,
        seen_off_m=attempt.seen_off,
    )  # fmt: skip


def _find_thing(arm: ArmInMemory, planner: ArmPlanner, camera: "ArmCamera") -> Thing | None:
    """Return the nearest thing that the camera sees; the arm moves out of its view."""
    lookout = Lookout()
    while not (seen := camera.look(arm.state())):
        posture = lookout.aside(arm.description)
        if posture is None:
            return None
        aside = planner.take_posture(posture, [], arm.posture(planner.arm.names), None)
        if isinstance(aside, Plan):
            arm.carry_out_all(aside.phases)
    known, _ = located({}, seen, floor=floor_of(arm.description))
    return thing_of("the thing", known[f"seen {seen[0].id}"])


def _pick_and_place(
    arm: ArmInMemory,
    planner: ArmPlanner,
    look: Callable[[], Thing | None],
    drawn: Drawn,
    rng: np.random.Generator,
    attempt: Attempt,
) -> None:
    """Pick the thing up and put it down at a reachable place; fill in the attempt."""
    names = planner.arm.names
    hold = _pick(arm, planner, look, drawn, attempt)
    if hold is None:
        return
    if arm.thing()[2] < drawn.height + LIFTED_M:
        return attempt.end("not lifted")
    place: Plan | NoWay = NoWay(reason="")
    for target in _targets(rng, hold.thing.half[2], pan_axis(planner.arm)):
        place = planner.place(hold, target, [], arm.posture(names))
        if isinstance(place, Plan):
            break
    if isinstance(place, NoWay):
        return attempt.end("no place", place.reason)
    arm.carry_out_all(place.phases)
    arm.settle()
    attempt.target = target
    return None


def _pick(
    arm: ArmInMemory,
    planner: ArmPlanner,
    look: Callable[[], Thing | None],
    drawn: Drawn,
    attempt: Attempt,
) -> Hold | None:
    """Pick the thing up with as many tries as decision has; return the hold, or None."""
    for misses in range(TRIES):
        thing = look()
        if thing is None:
            attempt.end("not seen")
            return None
        attempt.seen_off = float(np.hypot(*(thing.position - arm.thing())[:2]))
        begin_s = time.monotonic()
        pick = planner.pick(thing, [], arm.posture(planner.arm.names), misses)
        attempt.planning_s = time.monotonic() - begin_s
        if isinstance(pick, NoWay):
            attempt.end("not gripped" if misses else "unreachable", pick.reason)
            return None
        hold = _execute_pick(arm, planner, pick, thing)
        if hold:
            return hold
        back = planner.back_off(pick, arm.posture(planner.arm.names))
        arm.carry_out_all(back.phases)
    attempt.end("not gripped")
    return None


def _execute_pick(arm: ArmInMemory, planner: ArmPlanner, pick: Plan, thing: Thing) -> Hold | None:
    """Execute a pick; return the hold, or None as soon as the gripper is empty."""
    assert pick.hold
    assert planner.arm.gripper
    gripper, hold = planner.arm.gripper.name, pick.hold
    for phase in pick.phases:
        arm.carry_out(phase)
        if phase.name == "close":
            posture = np.array([arm.measured(name) for name in planner.arm.names])
            hold = planner.gripped(hold, thing, posture)
            hold = _adjust_grip(arm, planner, hold, gripper)
        if phase.name == "lift":
            place = planner.squeeze(arm.measured(gripper), hold.grip, moving=False)
            arm.carry_out(Phase(name="grip", gripper=place))
            hold = _adjust_grip(arm, planner, dataclasses.replace(hold, grip=place), gripper)
        if phase.name in {"close", "lift"} and not planner.holds(arm.measured(gripper), hold.grip):
            return None
    return hold


def _adjust_grip(arm: ArmInMemory, planner: ArmPlanner, hold: Hold, gripper: str) -> Hold:
    """Adjust the gripper's force for a moving arm, like decision."""
    while True:
        place = planner.squeeze(arm.measured(gripper), hold.grip, moving=True)
        if place == hold.grip:
            return hold
        arm.carry_out(Phase(name="squeeze", gripper=place))
        hold = dataclasses.replace(hold, grip=place)


def _targets(rng: np.random.Generator, height: float, pan: float) -> Iterator[Floats]:
    for _ in range(TARGETS):
        far, angle = rng.uniform(*REACH_M), rng.uniform(-AROUND_RAD, AROUND_RAD)
        yield np.array([pan + far * math.cos(angle), far * math.sin(angle), height])
