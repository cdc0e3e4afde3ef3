"""Collision-free paths and trajectories, and grasps; separate models judge them."""

import math

import mujoco
import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import KeepOut
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.manipulation.arm_planner import ArmPlanner, Plan, surroundings
from gigabrain_zenoh.manipulation.collision import CollisionChecker, Thing
from gigabrain_zenoh.manipulation.grasps import ROOM_M, Grasp, GraspPlanner, NoGrasp
from gigabrain_zenoh.manipulation.inverse_kinematics import Reachable, ToolGoal
from gigabrain_zenoh.manipulation.joint_trajectory import JointTrajectory, TimeParametrization
from gigabrain_zenoh.manipulation.planner import JointPath, NoPath, plan
from tests.unit.manipulation.arms import JOINTS, MODEL, arm, inverse, postures

FLOOR = Thing(name="floor", kind="floor")
SHELF = Thing(name="shelf", kind="box", size=(0.2, 0.4, 0.02), position=np.array([0.3, 0, 0.16]))
CUBE = Thing(name="cube", kind="box", size=(0.03,) * 3, position=np.array([0, 0, 0.015]))
WORLD = """
<geom name="floor" type="plane" size="0 0 1"/>
<geom name="shelf" type="box" size=".1 .2 .01" pos=".3 0 .16"/>
<body name="base">"""
BOX = '<geom name="cube" type="box" size=".015 .015 .015" pos=".0981274 -.000218 .0071"/>'


class Judge:
    """Finds contacts in a handwritten MuJoCo world."""

    def __init__(self, *, held: bool = False) -> None:
        text = MODEL.read_text().replace('<body name="base">', WORLD)
        text = text.replace('<site name="tool"', f'{BOX}<site name="tool"') if held else text
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)

    def contacts(self, posture: Floats) -> list[str]:
        self.data.qpos[:5] = posture
        mujoco.mj_fwdPosition(self.model, self.data)
        return [
            f"{self.model.geom(one.geom1).name} {self.model.geom(one.geom2).name} {one.dist:.4f}"
            for one in self.data.contact
            if one.dist < 0
        ]


def test_a_free_posture_has_no_contacts_in_mujoco() -> None:
    checker, judge = CollisionChecker(arm(), [FLOOR, SHELF], margin=0.0), Judge()
    free = 0
    for posture in postures(1000):
        free += (is_free := checker.is_free(posture))
        assert is_free == (not judge.contacts(posture)), judge.contacts(posture)
    assert 200 < free < 800


def test_the_clearance_is_the_distance_to_the_named_thing() -> None:
    ball = Thing(name="ball", kind="sphere", size=(0.02,), position=np.array([0.45, 0.0, 0.2205]))
    found = CollisionChecker(arm(), [ball]).clearance(np.zeros(5))
    assert set(found.pair or ()) == {"pad_fixed", "ball"}
    assert found.distance == pytest.approx(0.45 - 0.02 - 0.2932354 - 0.1045, abs=0.001)


def test_a_held_thing_collides_unless_it_is_ignored() -> None:
    low = Thing(name="table", kind="box", size=(1, 1, 0.1), position=np.array([0.6, 0, 0.13]))
    posture = np.zeros(5)
    hand = CollisionChecker(arm(), [low], margin=0.0)
    assert hand.touches(posture) == ""
    bag = Thing(name="bag", kind="box", size=(0.03, 0.03, 0.1), position=np.array([0, 0, 0.0]))
    assert "held" in CollisionChecker(arm(), [low], held=bag, margin=0.0).touches(posture)
    ignoring = CollisionChecker(arm(), [low], held=bag, margin=0.0, ignore=[("held", "table")])
    assert ignoring.touches(posture) == ""


@pytest.mark.parametrize(
    "make",
    [
        lambda: Thing(name="a", kind="box", size=(0.1,)),
        lambda: Thing(name="a", kind="sphere", size=(math.inf,)),
        lambda: Thing(name="a", kind="sphere", size=(0.1,), position=np.full(3, math.nan)),
        lambda: CollisionChecker(arm(), [FLOOR, FLOOR]),
        lambda: CollisionChecker(arm(), [Thing(name="wrist", kind="sphere", size=(0.1,))]),
        lambda: CollisionChecker(arm(), [], ignore=[("held", "floor")]),
    ],
)
def test_wrong_things_are_refused(make: object) -> None:
    with pytest.raises(ConfigError):
        make()  # type: ignore[operator]


def below_and_above(checker: CollisionChecker, count: int) -> list[tuple[Floats, Floats]]:
    """Return pairs of free postures, below the shelf and above it."""
    random, found = np.random.default_rng(3), []

    def reach(low: float, high: float) -> Floats:
        while True:
            place = random.uniform((0.2, -0.15, low), (0.33, 0.15, high))
            solved = inverse().solve(ToolGoal(position=place), None, checker.touches)
            if isinstance(solved, Reachable):
                return solved.posture

    while len(found) < count:
        found.append((reach(0.03, 0.1), reach(0.22, 0.3)))
    return found


def assert_within_limits(trajectory: JointTrajectory) -> None:
    for values, limit in (
        (trajectory.velocities, 3.0),
        (trajectory.accelerations, 10.0),
        (np.diff(trajectory.accelerations, axis=0) / np.diff(trajectory.times)[:, None], 200.0),
    ):
        assert np.abs(values).max() <= limit * 1.0001
    assert all(arm().inside(posture) for posture in trajectory.positions)
    assert not np.any(trajectory.velocities[-1]) or np.abs(trajectory.velocities[-1]).max() < 1e-9


@pytest.mark.long
def test_a_trajectory_round_a_shelf_with_a_held_cube_touches_nothing() -> None:
    checker = CollisionChecker(arm(), [FLOOR, SHELF], held=CUBE)
    judge, timing = Judge(held=True), TimeParametrization(arm().joints, period=0.005)
    for number, (start, goal) in enumerate(below_and_above(checker, 4)):
        path = plan(checker, start, goal, seed=number, time_limit=60.0)
        assert isinstance(path, JointPath)
        trajectory = timing.trajectory(path.postures, checker=checker)
        assert np.allclose(trajectory.positions[[0, -1]], (start, goal), atol=1e-6)
        assert_within_limits(trajectory)
        stops = sum(
            timing.trajectory(path.postures[k : k + 2]).duration
            for k in range(len(path.postures) - 1)
        )
        assert trajectory.duration <= stops + 1e-6
        for posture in trajectory.positions:
            assert judge.contacts(posture) == []


@pytest.mark.long
def test_a_plan_is_the_same_for_the_same_seed() -> None:
    checker = CollisionChecker(arm(), [FLOOR, SHELF])
    ((start, goal),) = below_and_above(checker, 1)
    first, second = (plan(checker, start, goal, seed=5, time_limit=60.0) for _ in range(2))
    assert isinstance(first, JointPath)
    assert isinstance(second, JointPath)
    assert np.array_equal(first.postures, second.postures)


def test_an_impossible_plan_has_a_cause() -> None:
    checker = CollisionChecker(arm(), [FLOOR, SHELF])
    ((below, above),) = below_and_above(checker, 1)
    into = np.array([0.0, 1.2, 0.5, 0.0, 0.0])
    causes = {
        "limits": plan(checker, below, np.full(5, 9.0)),
        "start": plan(checker, into, above),
        "goal": plan(checker, below, into),
        "time": plan(checker, below, above, time_limit=0.0),
    }
    for cause, found in causes.items():
        assert isinstance(found, NoPath)
        assert found.cause == cause
    assert "floor" in causes["goal"].reason  # type: ignore[union-attr]


def near_the_shelf(checker: CollisionChecker, posture: Floats, gap: float) -> Floats:
    """Return a posture, lifted by the shoulder from below the shelf up to a gap [m]."""
    low, high = posture, posture.copy()
    while checker.clearance(high).distance > gap:
        high = high - np.array([0.0, 0.02, 0.0, 0.0, 0.0])
    for _ in range(30):
        middle = (low + high) / 2
        far = checker.clearance(middle).distance > gap
        low, high = (middle, high) if far else (low, middle)
    return low


@pytest.mark.long
@pytest.mark.parametrize("gap", [0.0012, -0.003, -0.008])
def test_a_start_that_is_slightly_too_near_is_left_without_coming_nearer(gap: float) -> None:
    checker = CollisionChecker(arm(), [FLOOR, SHELF], margin=0.002)
    pairs = [(near_the_shelf(checker, a, gap), b) for a, b in below_and_above(checker, 5)]
    inside = [(start, above) for start, above in pairs if arm().inside(start)]
    assert len(inside) >= 3
    for start, above in inside:
        assert checker.touches(start)
        found = plan(checker, start, above)
        assert isinstance(found, JointPath)
        assert np.array_equal(found.postures[0], start)
        first, second = found.postures[:2]
        on_the_way = [first + share * (second - first) for share in np.linspace(0.0, 1.0, 20)]
        rooms = [checker.clearance(one).distance for one in on_the_way]
        assert min(rooms) > gap - 1e-4
        assert checker.is_free(second)


def test_a_start_in_motion_goes_on_smoothly() -> None:
    timing = TimeParametrization(arm().joints)
    speed = np.array([1.0, 0.0, -0.5, 0.0, 0.0])
    moving = timing.trajectory(np.stack((np.zeros(5), np.full(5, 0.5))), velocity=speed)
    assert np.allclose(moving.velocities[0], speed)
    assert_within_limits(moving)


def test_limits_that_ruckig_refuses_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    timing = TimeParametrization(arm().joints)
    monkeypatch.setattr(timing, "joints", tuple(replace(j, max_jerk=-1.0) for j in timing.joints))
    with pytest.raises(Refused, match=r"no trajectory within the limits of the joints: .*jerk"):
        timing.trajectory(np.stack((np.zeros(5), np.full(5, 0.5))))


@pytest.mark.parametrize("speed", [0.91, 1.5, 1.57])  # shares of 2.6, 3 and 3.14
def test_a_joint_may_pass_corners_at_its_top_speed(speed: float) -> None:
    timing = TimeParametrization([replace(one, max_speed=speed) for one in arm().joints])
    moves = np.random.default_rng(0).uniform(0.0, 0.3, (200, 2, 5))
    moves[:, :, 0] += 0.3  # the first joint is the slowest all the way
    for ways in moves:
        found = timing.trajectory(np.concatenate((np.zeros((1, 5)), np.cumsum(ways, axis=0))))
        assert np.allclose(found.positions[-1], ways.sum(axis=0))
        assert np.abs(found.velocities).max() < speed + 1e-9


def test_a_move_of_zero_length_takes_no_time() -> None:
    still = TimeParametrization(arm().joints).trajectory(np.zeros((2, 5)))
    assert still.duration == 0.0
    assert np.array_equal(still.positions, np.zeros((1, 5)))


@pytest.mark.parametrize(
    ("kind", "size"),
    [("box", (0.03, 0.03, 0.03)), ("cylinder", (0.015, 0.04)), ("sphere", (0.02,))],
)
def test_things_on_the_table_can_be_grasped(kind: str, size: tuple[float, ...]) -> None:
    planner = GraspPlanner(arm(), inverse())
    thing = Thing(name="it", kind=kind, size=size, position=np.array([0.22, 0.05, 0.02]))  # type: ignore[arg-type]
    found = planner.grasps(thing, [FLOOR])
    assert isinstance(found, list)
    clearances = [one.clearance for one in found]
    assert clearances == sorted(clearances, reverse=True)
    for grasp in found:
        assert_held(grasp, thing)


def test_a_wide_thing_is_grasped_from_above_if_the_clearance_suffices() -> None:
    planner = GraspPlanner(arm(), inverse())
    can = Thing(
        name="can", kind="cylinder", size=(0.034, 0.11), position=np.array([0.22, 0.05, 0.055])
    )
    found = planner.grasps(can, [FLOOR])
    assert isinstance(found, list)
    order = [(-min(one.clearance, ROOM_M), one.tilt) for one in found]
    assert order == sorted(order)
    assert found[0].tilt == min(one.tilt for one in found)


def assert_held(grasp: Grasp, thing: Thing) -> None:
    """Assert that the thing is between the fingers, and the open hand touches nothing."""
    tool = arm().forward(grasp.posture)
    middle = tool.axes.T @ (thing.position - tool.position)
    opening = arm().opening()
    assert middle[2] == pytest.approx(opening.middle(grasp.opening), abs=0.003)
    assert abs(middle[1]) < 0.002
    assert opening.position(grasp.width) < grasp.opening
    checker = CollisionChecker(arm(), [FLOOR, thing], gripper=grasp.opening, margin=0.0)
    for share in np.linspace(0, 1, 50):
        posture = grasp.before + (grasp.posture - grasp.before) * share
        assert checker.touches(posture) == ""


@pytest.mark.long
def test_an_impossible_grasp_has_a_reason() -> None:
    planner = GraspPlanner(arm(), inverse())
    wide = Thing(name="crate", kind="box", size=(0.2,) * 3, position=np.array([0.25, 0, 0.1]))
    far = Thing(name="ball", kind="sphere", size=(0.02,), position=np.array([1.0, 0, 0.02]))
    for thing, reason in ((wide, "crate is 20.0 cm wide"), (far, "too far by")):
        found = planner.grasps(thing, [FLOOR])
        assert isinstance(found, NoGrasp)
        assert reason in found.reason


def test_joints_of_another_arm_are_refused() -> None:
    with pytest.raises(ConfigError):
        type(arm())(MODEL.read_text(), JOINTS[5:])


def test_the_clearance_from_boxes_is_larger_than_safetys() -> None:
    body = load_robot("so101").description()
    assert body.arm
    shelf = KeepOut(name="shelf", center=(0.3, 0.0, 0.2), size=(0.2, 0.4, 0.02))
    _, kept = surroundings(replace(body, arm=replace(body.arm, floor=0.0, keep_out=(shelf,))))
    for side, given in zip(kept.size, shelf.size, strict=True):
        assert side / 2 > given / 2 + body.thresholds.arm_clearance + 0.002


def test_the_clearance_from_the_floor_is_larger_than_safetys_if_possible() -> None:
    body = load_robot("so101").description()
    planner, random = ArmPlanner(MODEL.read_text(), body), np.random.default_rng(0)
    floor = CollisionChecker(planner.arm, [Thing(name="floor", kind="floor")], margin=0.0)
    assert body.arm
    posture = np.array(body.arm.home[:-1])
    lowest = []
    for _ in range(12):
        point = random.uniform((0.15, -0.2, 0.02), (0.3, 0.2, 0.05))
        found = planner.reach(point, None, [], posture, None)
        if isinstance(found, Plan):
            (move,) = found.phases
            assert move.arm
            for one in move.arm.positions[5:]:
                near = floor.clearance(one)
                if near.pair and "floor" in near.pair:
                    lowest.append(near.distance)
            posture = move.arm.positions[-1]
    assert min(lowest) > body.thresholds.arm_clearance
