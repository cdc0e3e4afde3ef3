"""`gigabrain bench reach`: an arm goes to random goals near its body, past a shelf.

Planner, control, safety and gate are the same as on a robot; they run in memory on a simulated
body. The physics give the contacts on the way, and the tool's true position at rest.
"""

import math
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_link
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_drivers.sim.body import MujocoOptions, SimModel, sim_body
from gigabrain_drivers.sim.scene import ROBOT
from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.body import KeepOut
from gigabrain_schemas.brain import Intent
from gigabrain_zenoh.decision.arm_readings import off_from, pace
from gigabrain_zenoh.decision.manipulator import HOLD_UPS, WAIT_TICKS
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.manipulation.arm_planner import MARGIN_M, ArmPlanner, surroundings
from gigabrain_zenoh.manipulation.collision import CollisionChecker
from gigabrain_zenoh.manipulation.inverse_kinematics import InverseKinematics, OutOfReach
from gigabrain_zenoh.manipulation.phases import Phase, PhaseRun
from gigabrain_zenoh.manipulation.pick_place import LIMIT_SPARE, NoWay
from gigabrain_zenoh.qa.bench.hands import ArmInMemory
from gigabrain_zenoh.safety.arm_shape import MujocoArm
from gigabrain_zenoh.safety.step import SafetyInputs, SafetyMemory, step

LOW, HIGH = (-0.3, -1.0, -0.1), (1.0, 1.0, 0.9)  # range of goals, in lengths of the stretched arm
SHELF_AT, SHELF_SIZE = (0.7, 0.0, 0.36), (0.45, 0.9, 0.04)  # in the same unit
PITCHES_RAD = -math.pi / 6, math.pi / 2  # range of the tool's pitch, for every other goal
SHOW_EVERY = 100
REST_TICKS = 100  # at a goal, until control has corrected the sag by the arm's weight
REASON = "going to a goal"
Progress = Callable[[str], None]


class Times(Struct, frozen=True, kw_only=True):
    """Wall times of one operation."""

    n: int
    p50_ms: float
    p95_ms: float
    p99_ms: float


class ReachResult(Struct, frozen=True, kw_only=True):
    """The results of all goals."""

    body: str
    seed: int
    goals: int
    reached: int
    refused: dict[str, int]  # number of goals without a posture, by cause
    no_way: dict[str, int]  # number of goals with a posture but without a path, by reason
    held: int  # number of goals that safety kept the arm from
    touched: tuple[str, ...]  # a line for each goal with a contact on the way
    off_p95_m: float  # of the tool from its goal, 2 s after it was reached
    solved: Times  # inverse kinematics of goals with a posture
    unsolved: Times  # the same, of goals without one
    planned: Times  # posture, path and trajectory


class JudgedArm(ArmInMemory):
    """An arm in memory with safety; it records the true contacts, also with itself."""

    def __init__(self, robot: RobotFile, body: SimModel, world: Path) -> None:
        self.touched = set[str]()
        self._shape = MujocoArm(body.model, robot.description())
        self._safety_memory = SafetyMemory()
        super().__init__(robot, body, world)

    def step(self, intent: Intent) -> None:
        """Step 20 ms, and record contacts."""
        inputs = SafetyInputs(state=self.state(), arm=self._shape)
        self._safety_memory, verdict = step(self.description, self._safety_memory, inputs)
        self.caps = verdict.joints
        super().step(intent)
        model, contact = self.simulation.model, self.simulation.data.contact
        own = model.body_rootid[model.geom_bodyid] == model.body(f"{ROBOT}base").id
        for pair in contact.geom[(contact.dist < 0.0) & own[contact.geom].any(axis=1)]:
            self.touched.add(" and ".join(model.geom(geom).name or "something" for geom in pair))

    def follow(self, phases: Sequence[Phase]) -> bool:
        """Execute the phases of a plan; return whether the arm reaches its end in time."""
        run = PhaseRun(phases, self.description.joints[-1].name, self.state().tick)
        while run.phase:
            state = self.state()
            run.wait(state.tick, *pace(self.description, state))
            if run.waited > WAIT_TICKS:
                return False
            run.advance(state.tick)
            joints, window = run.wish(state.tick)
            self.step(
                Intent(joints=joints, joint_trajectory=window, behaviour="reach", reason=REASON)
            )
        last, arm = phases[-1].arm, self.description.arm
        assert last
        assert arm
        end = dict(zip(last.names, last.positions[-1].tolist(), strict=True))
        while off_from(self.description, self.state(), end, "goal_tolerance"):
            if run.over_for(self.state().tick) * TICK_S > arm.goal_time:
                return False
            self.step(Intent(behaviour="reach", reason=REASON))
        return True


def measure_reach(body: str, goals: int, seed: int, show: Progress) -> ReachResult:
    """Send an arm to goals. Raises ConfigError for a body without an arm, or one that drives."""
    robot, _, options, folder = load_link(body, Run(folder=Path()))
    if robot.arm is None or robot.description().has_base or not isinstance(options, MujocoOptions):
        raise ConfigError(f"{body} has no arm that stands in MuJoCo; choose so101 or piper")
    model = sim_body(robot, options, Run(folder=folder))
    course = Course(robot, model)
    rng = np.random.default_rng(seed)
    for number in range(1, goals + 1):
        course.go(rng, with_pitch=number % 2 == 0)
        if number % SHOW_EVERY == 0:
            show(f"{number} of {goals} goals, {len(course.off)} reached")
    return course.result(body, seed)


class Course:
    """One arm, and the results of its goals so far."""

    def __init__(self, robot: RobotFile, model: SimModel) -> None:
        assert robot.arm
        kinematics = ArmKinematics(model.model, robot.description().joints, robot.arm.tool)
        self._kinematics, self._inverse = kinematics, InverseKinematics(kinematics, LIMIT_SPARE)
        base = kinematics.chain.fixed[0, :2, 3]
        self._reach = float(np.linalg.norm(base) + kinematics.levers(0.0)[0])  # [m]
        x, y, z, length, width, thick = (self._reach * one for one in (*SHELF_AT, *SHELF_SIZE))
        shelf = KeepOut(name="shelf", center=(x, y, z), size=(length, width, thick))
        robot = replace(robot, arm=replace(robot.arm, keep_out=(shelf,)))
        description = robot.description()
        self._planner = ArmPlanner(model.model, description)
        around = surroundings(description)
        self._checker = CollisionChecker(kinematics, around, margin=MARGIN_M)
        self._arm = _arm_with_shelf(shelf, robot, model)
        self._held = 0
        self._refused, self._no_way, self._touched = Counter[str](), Counter[str](), list[str]()
        self._solved, self._unsolved, self._planned = list[float](), list[float](), list[float]()
        self.off: list[float] = []  # [m]

    def go(self, rng: np.random.Generator, *, with_pitch: bool) -> None:
        """Draw a goal, and go there if possible."""
        point = self._reach * rng.uniform(LOW, HIGH)
        pitch = float(rng.uniform(*PITCHES_RAD)) if with_pitch else None
        if not self._has_posture(point, pitch, self._arm.posture(self._kinematics.names)):
            return
        self._arm.touched.clear()
        arrived = self._reach_goal(point, pitch)
        for _ in range(REST_TICKS):
            self._arm.step(Intent(behaviour="reach", reason="done"))
        if self._arm.touched:
            where = ", ".join(f"{one:.3f}" for one in point)
            self._touched.append(f"to ({where}): {'; '.join(sorted(self._arm.touched))}")
        if arrived:
            places = dict(zip(self._arm.arm.names, self._arm.arm.truth()[0], strict=True))
            posture = np.array([places[name] for name in self._kinematics.names])
            self.off.append(
                float(np.linalg.norm(self._kinematics.forward(posture).position - point))
            )

    def _reach_goal(self, point: Floats, pitch: float | None) -> bool:
        """Return whether the arm reaches a goal; if safety holds it up, plan again."""
        for _ in range(1 + HOLD_UPS):
            begin_s = time.perf_counter()
            posture = self._arm.posture(self._kinematics.names)
            plan = self._planner.reach(point, pitch, [], posture, None)
            if isinstance(plan, NoWay):
                self._no_way[plan.reason] += 1
                return False
            self._planned.append((time.perf_counter() - begin_s) * 1000)
            if self._arm.follow(plan.phases):
                return True
        self._held += 1
        return False

    def _has_posture(self, point: Floats, pitch: float | None, posture: Floats) -> bool:
        """Return whether there is a posture for a goal; record the time of the search."""
        goal = self._planner.tool_goal(point, pitch)
        begin_s = time.perf_counter()
        found = self._inverse.solve(goal, posture, self._checker.touches)
        took_ms = (time.perf_counter() - begin_s) * 1000
        if isinstance(found, OutOfReach):
            self._refused[found.cause] += 1
            self._unsolved.append(took_ms)
            return False
        self._solved.append(took_ms)
        return True

    def result(self, body: str, seed: int) -> ReachResult:
        """Return the results so far."""
        return ReachResult(
            body=body, seed=seed, goals=len(self._solved) + len(self._unsolved),
            reached=len(self.off), refused=dict(self._refused), no_way=dict(self._no_way),
            held=self._held, touched=tuple(self._touched),
            off_p95_m=percentile(sorted(self.off), 0.95) or 0.0,
            solved=_times(self._solved), unsolved=_times(self._unsolved),
            planned=_times(self._planned),
        )  # fmt: skip


def _arm_with_shelf(shelf: KeepOut, robot: RobotFile, model: SimModel) -> JudgedArm:
    """Return an arm on a floor, with a shelf in front of it."""
    place = " ".join(f"{one:g}" for one in shelf.center)
    half = " ".join(f"{one / 2:g}" for one in shelf.size)
    with tempfile.TemporaryDirectory(prefix="gigabrain-") as folder:
        (Path(folder) / "shelf.xml").write_text(f"""<mujoco><worldbody>
          <geom name="floor" type="plane" size="2 2 .1"/>
          <geom name="shelf" type="box" pos="{place}" size="{half}"/>
          </worldbody></mujoco>""")
        world = Path(folder) / "world.yaml"
        world.write_text("model: shelf.xml\nstart: [0.0, 0.0, 0.0]\n")
        return JudgedArm(robot, model, world)


def _times(wall_ms: Sequence[float]) -> Times:
    p50, p95, p99 = (round(percentile(sorted(wall_ms), at) or 0.0, 2) for at in (0.5, 0.95, 0.99))
    return Times(n=len(wall_ms), p50_ms=p50, p95_ms=p95, p99_ms=p99)
