"""Shows viewers the path of the arm's tool, and the grasps that were considered."""

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
    """Publishes the current plan when it changes, but only while there are subscribers."""

    def __init__(self, bus: Bus) -> None:
        self._bus, self._watched = bus, False
        self._due = False  # a new subscriber needs the current plan, changed or not
        self._shown: Plan | None = None
        self._close = bus.transport.watch_readers(ARM_PLAN.key, self._on_readers)

    def show(self, planner: ArmPlanner | None, plan: Plan | None) -> None:
        """Publish a plan, or its absence; called at each step."""
        if not self._watched or (plan is self._shown and not self._due):
            return
        self._due, self._shown = False, plan
        self._bus.publish(ARM_PLAN, described(planner.arm, plan) if planner and plan else ArmPlan())

    def close(self) -> None:
        """Stop watching for subscribers."""
        self._close()

    def _on_readers(self, subscribed: bool) -> None:
        self._watched = self._due = subscribed


def described(arm: ArmKinematics, plan: Plan) -> ArmPlan:
    """Return a plan in the format for viewers."""
    postures = [phase.arm.positions for phase in plan.phases if phase.arm]
    return ArmPlan(
        path=_path(arm, np.concatenate(postures)).astype("<f4").tobytes() if postures else b"",
        grasps=tuple(_poses(arm, plan.grasps[:MAX_GRASPS])),
    )


def _path(arm: ArmKinematics, postures: Floats) -> Floats:
    """Return the tool's path (k, 3) [m] for postures (n, joints), thinned to STEP_M."""
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
        centre = np.array([0.0, 0.0, opening.middle(grasp.opening)])
        x, y, z = grasp.tool.place(centre).tolist()
        w, i, j, k = grasp.tool.quaternion.tolist()
        yield GraspPose(position=(x, y, z), orientation=(i, j, k, w), opening=grasp.width)
