"""Distances of an arm by MuJoCo: accepted models, distances and gradients."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.body import (
    Arm,
    BodyDescription,
    JointDescription,
    KeepOut,
)
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.joints import JointMotion
from gigabrain_zenoh.safety.arm_motion import Near, limits
from gigabrain_zenoh.safety.arm_shape import MujocoArm

SO101 = load_robot("so101").description()
assert SO101.arm
SHELF = KeepOut(name="shelf", center=(0.3, 0.1, 0.2), size=(0.1, 0.2, 0.02), yaw=0.3)
BODY = replace(SO101, arm=replace(SO101.arm, floor=0.0, keep_out=(SHELF,)))
FAR = 10.0
ROUND = """<mujoco><worldbody>
<body name="base"><geom name="foot" size=".05" pos="0 0 -1"/>
<body name="link" pos="0 0 .5"><joint name="turn" axis="0 1 0"/><geom name="{kind}" type="{kind}"
 size="{size}" pos=".2 0 0"/>
<body name="end" pos=".4 0 0"><joint name="slide" type="slide" axis="1 0 0" range="0 .2"/>
<geom name="tip" type="sphere" size=".02"/>
<body name="mirror"><joint name="follower" type="slide" axis="1 0 0" range="-.2 .2"/>
<geom name="other" size=".01"/></body></body></body></body>
</worldbody><equality><joint joint1="follower" joint2="slide" polycoef="0 -2 0 0 0"/></equality>
</mujoco>"""
TWO = BodyDescription(
    robot_type="crane",
    drive_type="arm",
    footprint=((0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.1, -0.1)),
    joints=(
        JointDescription(name="turn", lower=-2.0, upper=2.0, max_speed=1.0),
        JointDescription(name="slide", lower=0.0, upper=0.2, max_speed=0.2),
    ),
    arm=Arm(home=(0.0, 0.0), floor=0.0),
)


def model() -> str:
    path = Path(sys.modules["gigabrain_drivers"].__path__[0]) / "bodies/so101/model.xml"
    return path.read_text()


def within(arm: MujocoArm, posture: NDArray[np.float64], far: float = FAR) -> Near:
    return arm.near(posture[None], np.full((1, len(arm.levers)), far))


def distances(arm: MujocoArm, posture: NDArray[np.float64]) -> dict[int, float]:
    near = within(arm, posture)
    return dict(zip(near.pairs.tolist(), near.distances.tolist(), strict=True))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('<mujoco><include file="more.xml"/></mujoco>', "'include'"),
        ('<mujoco><asset><mesh name="a" vertex="0 0 0"/></asset></mujoco>', "'mesh'"),
        ('<mujoco><asset><texture file="a.png"/></asset></mujoco>', "'file'"),
        ("<mujoco>" + " " * 262_144 + "</mujoco>", "larger than 256 kB"),
        ("<mujoco", "the arm's model: "),
        ("<mujoco/>", "no joint 'shoulder_pan'"),
    ],
)
def test_an_unsupported_model_is_refused_in_one_line(text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as error:
        MujocoArm(text, BODY)
    assert "\n" not in str(error.value)


def check_gradients(arm: MujocoArm, postures: NDArray[np.float64]) -> None:
    step, checked = 1e-6, 0
    for posture in postures:
        near = within(arm, posture)
        before = distances(arm, posture)
        assert (np.abs(near.gradients) <= arm.levers[near.pairs] + 1e-9).all()
        for joint in range(len(posture)):
            moved = posture.copy()
            moved[joint] += step
            after = distances(arm, moved)
            found = [(after[pair] - before[pair]) / step for pair in near.pairs.tolist()]
            wrong = np.abs(near.gradients[:, joint] - found) > 0.01
            assert wrong.mean() <= 0.05  # at an edge, the nearest points jump
            checked += len(found)
    assert checked > 100


def test_gradients_match_differences_of_distances() -> None:
    lower, upper = np.array([(joint.lower, joint.upper) for joint in BODY.joints]).T
    check_gradients(
        MujocoArm(model(), BODY), np.random.default_rng(1).uniform(lower, upper, (8, len(lower)))
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "size"),
    [
        ("sphere", ".05"),
        ("capsule", ".03 .1"),
        ("cylinder", ".03 .1"),
        ("ellipsoid", ".03 .05 .1"),
        ("box", ".03 .05 .1"),
    ],
)
def test_the_lowest_point_of_each_kind_of_shape_is_above_the_floor(kind: str, size: str) -> None:
    arm = MujocoArm(ROUND.format(kind=kind, size=size), TWO)
    check_gradients(arm, np.random.default_rng(2).uniform(0.1, 0.19, (20, 2)))


def test_an_equality_makes_a_joint_follow_another() -> None:
    arm = MujocoArm(ROUND.format(kind="sphere", size=".05"), TWO)
    near = within(arm, np.array([0.3, 0.1]))
    named = {arm.describe(pair)[1:]: index for index, pair in enumerate(near.pairs.tolist())}
    tip = near.gradients[named["end", "the floor"], 1]
    other = near.gradients[named["mirror", "the floor"], 1]
    assert other == pytest.approx(-tip)  # twice the motion of its parent, in the other direction


def test_many_postures_at_once_give_the_same_pairs_as_each_alone() -> None:
    lower, upper = np.array([(joint.lower, joint.upper) for joint in BODY.joints]).T
    arm, rng = MujocoArm(model(), BODY), np.random.default_rng(3)
    postures = rng.uniform(lower, upper, (20, len(lower)))
    limits_of_pairs = rng.uniform(-0.01, 0.15, (20, len(arm.levers)))
    near = arm.near(postures, limits_of_pairs)
    for index, posture in enumerate(postures):
        each, rows = distances(arm, posture), near.postures == index
        found = dict(zip(near.pairs[rows].tolist(), near.distances[rows].tolist(), strict=True))
        limit = limits_of_pairs[index].tolist()
        assert found == pytest.approx({p: d for p, d in each.items() if d < limit[p]}, abs=1e-6)
        gradients = within(arm, posture).gradients[[list(each).index(pair) for pair in found]]
        assert near.gradients[rows] == pytest.approx(gradients, abs=1e-6)


def test_neighbours_and_shapes_that_cannot_move_apart_are_no_pairs() -> None:
    arm = MujocoArm(model(), BODY)
    pairs = {arm.describe(pair)[1:] for pair in range(len(arm.levers))}
    chain = ["base", "shoulder", "upper_arm", "lower_arm", "wrist", "gripper", "jaw"]
    assert not pairs & {*pairwise(chain), *((b, a) for a, b in pairwise(chain))}
    assert {("base", "gripper"), ("jaw", "shelf"), ("jaw", "the floor")} <= pairs
    assert not pairs & {("base", "shelf"), ("base", "the floor")}


@pytest.mark.long
def test_an_arm_that_falls_towards_the_floor_is_stopped_in_time() -> None:
    """Only the caps, a tick late, and the maximum accelerations limit the speeds."""
    arm, dt = MujocoArm(model(), replace(BODY, arm=replace(SO101.arm, floor=0.0))), 0.02
    posture, speeds = np.array([0.0, -0.4, 0.4, 0.0, 0.0, 0.0]), np.zeros(6)
    wanted = np.array([0.0, 3.0, 3.0, 3.0, 0.0, 0.0])
    lower, upper = np.array([(joint.lower, joint.upper) for joint in BODY.joints]).T
    caps = [np.full(6, np.inf)] * 2
    for _ in range(200):
        motion = [
            JointMotion(*pair) for pair in zip(posture.tolist(), speeds.tolist(), strict=True)
        ]
        found = limits(BODY.joints, arm, posture.tolist(), speeds.tolist(), motion, 0.005)
        by_name = {cap.name: cap.rise for cap in found.caps}
        rises = [by_name.get(joint.name) for joint in BODY.joints]
        caps = [caps[1], np.array([np.inf if rise is None else rise for rise in rises])]
        speeds = np.clip(np.minimum(wanted, caps[0]), speeds - 0.4, speeds + 0.4)
        ahead = np.clip(posture + speeds * dt, lower, upper)
        posture, speeds = ahead, (ahead - posture) / dt
        assert min(distances(arm, posture).values()) > 0.0
    assert [cause.code for cause in found.causes] == ["arm_floor"]


@pytest.mark.long
def test_mujoco_is_only_imported_for_an_arm() -> None:
    code = "import sys, gigabrain_zenoh.safety.node; print('mujoco' in sys.modules)"
    path = f"import sys; sys.path[:] = {sys.path!r}; {code}"
    done = subprocess.run((sys.executable, "-c", path), capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr
