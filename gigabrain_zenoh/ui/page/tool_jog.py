"""The place of an arm's tool, and joint speeds that move it along a line (damped least squares)."""

import math
from collections.abc import Sequence

from gigabrain_schemas.body import BodyDescription, JointDescription, RobotState
from gigabrain_zenoh.geometry.link_model import LinkModel, Vector, cross, rotated

DAMPING_M = 0.02  # [m/rad]; joints that move the tool less hardly move
GRADIENT_STEP = 1e-5  # [rad] or [m]
LIMIT_MARGIN = 0.02  # [rad] or [m]; a joint so close to the end of its range moves no closer


ToolPlace = tuple[float, float, float, float]  # x, y, z [m], and pitch [rad], positive is down


def tool_place(model: LinkModel, body: BodyDescription, state: RobotState) -> ToolPlace | None:
    """Return the place of the arm's tool in the frame of its base; None if unknown."""
    positions = {joint.name: joint.position for joint in state.joints}
    tool = body.arm.tool if body.arm else ""
    known = tool in (link.name for link in model.links)
    if not known or any(joint.name not in positions for joint in body.joints):
        return None
    place = model.place_in_base(tool, positions)
    ahead, aside, up = rotated(place.rotation, (1.0, 0.0, 0.0))
    return *place.position, -math.atan2(up, math.hypot(ahead, aside))


def tool_speeds(
    model: LinkModel, body: BodyDescription, state: RobotState, wanted: Vector
) -> dict[str, float]:
    """Return the speeds of the arm's joints at which its tool moves by `wanted` [m/s].

    The tool may turn on its way. If a joint would be too fast, all are scaled down. Empty if the
    model does not have the tool, or a joint is not measured.
    """
    positions = {joint.name: joint.position for joint in state.joints}
    tool = body.arm.tool if body.arm else ""
    joints = [joint for joint in body.joints if joint.part == "arm"]
    if tool not in (link.name for link in model.links) or any(
        j.name not in positions for j in joints
    ):
        return {}
    columns = {joint.name: _gradient(model, tool, positions, joint.name) for joint in joints}
    free = list(joints)
    while True:
        speeds = _least_squares([columns[joint.name] for joint in free], wanted)
        pairs = list(zip(free, speeds, strict=True))
        movable = [
            joint for joint, speed in pairs if not _at_end(joint, positions[joint.name], speed)
        ]
        if len(movable) == len(free):
            break
        free = movable
    excess = max([1.0, *(abs(speed) / joint.max_speed for joint, speed in pairs)])
    scaled = {joint.name: speed / excess for joint, speed in pairs}
    return {joint.name: scaled.get(joint.name, 0.0) for joint in joints}


def _gradient(model: LinkModel, tool: str, positions: dict[str, float], joint: str) -> Vector:
    """Return the derivative of the tool's x, y, z by a joint's position [m/rad or m/m]."""
    before, after = (
        model.place_in_base(tool, {**positions, joint: positions[joint] + step}).position
        for step in (-GRADIENT_STEP, GRADIENT_STEP)
    )
    x, y, z = ((b - a) / (2 * GRADIENT_STEP) for a, b in zip(before, after, strict=True))
    return x, y, z


def _at_end(joint: JointDescription, position: float, speed: float) -> bool:
    remaining = joint.upper - position if speed > 0 else position - joint.lower
    return speed != 0 and remaining < LIMIT_MARGIN


def _least_squares(columns: Sequence[Vector], wanted: Vector) -> list[float]:
    """Return Jᵀ (J Jᵀ + λ² I)⁻¹ v, for the columns of J."""
    damping = DAMPING_M**2
    rows = [[column[axis] for column in columns] for axis in range(3)]
    a, b, c = (
        [_dot(rows[i], rows[j]) + (damping if i == j else 0.0) for j in range(3)] for i in range(3)
    )
    bc, ca, ab = cross(b, c), cross(c, a), cross(a, b)
    determinant = _dot(a, bc)
    solved = [_dot(wanted, row) / determinant for row in (bc, ca, ab)]  # the matrix is symmetric
    return [_dot(column, solved) for column in columns]


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return math.fsum(x * y for x, y in zip(a, b, strict=True))
