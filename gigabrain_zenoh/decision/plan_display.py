"""Shows viewers where the arm's tool will go, and which grasps were considered."""

from collections.abc import Iterator, Sequence

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.brain import ArmPlan, GraspPose
from gigabrain_schemas.topics import ARM_PLAN
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.manipulation.arm_planner import ArmPlanner, Plan
from gigabrain_zenoh.manipulation.grasps import Grasp

STEP_M = 0.01  # between points of the path
MAX_POINTS, MAX_GRASPS = 400, 8


class PlanDisplay:
    """Publishes the present plan when it changes. It does nothing while nobody subscribes."""

    def __init__(self, bus: Bus) -> None:
        self._bus, self._watched = bus, False
        self._due = False  # whatever there is, as somebody has just begun to look
        self._shown: Plan | None = None
        self._close = bus.transport.watch_readers(ARM_PLAN.key, self._on_readers)

    def show(self, planner: ArmPlanner | None, plan: Plan | None) -> None:
        """Publish a plan, or that there is none. To be called at each step."""
        if not self._watched or (plan is self._shown and not self._due):
            return
        self._due, self._shown = False, plan
        self._bus.publish(ARM_PLAN, described(planner.arm, plan) if planner and plan else ArmPlan())

    def close(self) -> None:
        """End to watch for subscribers."""
        self._close()

    def _on_readers(self, there: bool) -> None:
        self._watched = self._due = there


def described(arm: ArmKinematics, plan: Plan) -> ArmPlan:
    """Return a plan for viewers."""
    postures = [phase.arm.positions for phase in plan.phases if phase.arm]
    return ArmPlan(
        path=_path(arm, np.concatenate(postures)).astype("<f4").tobytes() if postures else b"",
        grasps=tuple(_poses(arm, plan.grasps[:MAX_GRASPS])),
    )


def _path(arm: ArmKinematics, postures: Floats) -> Floats:
    """Return where the tool is (k, 3) [m] in postures (n, joints), without near repetitions."""
    kept: list[Floats] = []
    for posture in postures:
        place = arm.forward(posture).position
        if not kept or np.linalg.norm(place - kept[-1]) >= STEP_M:
            kept.append(place)
    return np.array(kept[:MAX_POINTS])


def _poses(arm: ArmKinematics, grasps: Sequence[Grasp]) -> Iterator[GraspPose]:
    opening = arm.opening() if grasps else None
    for grasp in grasps:
        assert opening
        between = np.array([0.0, 0.0, opening.middle(grasp.opening)])
        x, y, z = grasp.tool.place(between).tolist()
        w, i, j, k = grasp.tool.quaternion.tolist()
        yield GraspPose(position=(x, y, z), orientation=(i, j, k, w), opening=grasp.width)
