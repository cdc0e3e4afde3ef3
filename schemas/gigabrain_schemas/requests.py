"""Requests to a robot, and its replies."""

from typing import Annotated, Literal

from msgspec import Meta, field

from gigabrain_schemas.base import (
    Angle,
    Coordinate,
    Count,
    Finite,
    Key,
    Message,
    Name,
    Record,
    Text,
)
from gigabrain_schemas.body import GateStatus

Keys = Annotated[tuple[Key, ...], Meta(max_length=256)]
Figure = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]


class EstopRequest(Message, frozen=True, kw_only=True):
    """Stop at once, and stay stopped until a person releases it. It may be empty."""

    source: Name = "anonymous"
    reason: Text = ""


class ReleaseRequest(Message, frozen=True, kw_only=True):
    """Release a latched gate. The robot moves only after an enable as well."""

    estop_generation: Count  # as seen in robot/state, so that no stop is released unseen
    source: Name = "anonymous"


class EnableRequest(Message, frozen=True, kw_only=True):
    """Open the gate for the commands of one source."""

    source: Name  # "control" for the robot's own brain
    take: bool = False  # even if another source holds the body
    by: Name = ""  # the person who asks, if the source is the brain


class LimpRequest(Message, frozen=True, kw_only=True):
    """Let go of all joints, which may fall; or hold them again, where they are then."""

    limp: bool
    source: Name = "anonymous"


class GateReply(Message, frozen=True, kw_only=True):
    """The gate's answer to a request."""

    ok: bool
    text: Text  # a sentence for people
    robot_type: Name
    gate: GateStatus


class MapRequest(Message, frozen=True, kw_only=True):
    """Save the map, with the pose graph, where perception runs."""

    name: Annotated[
        str, Meta(pattern=r"^(?!.*\.(ya?ml|zones)$)\w[\w.-]*$(?!\n)", max_length=64)
    ]  # of its files, without ending
    replace: bool = False  # another map of that name
    source: Name = "anonymous"


class MapReply(Message, frozen=True, kw_only=True):
    """The result of saving a map, with its place."""

    ok: bool
    text: Text  # a sentence for people


class PoseRequest(Message, frozen=True, kw_only=True):
    """Look for the robot at a pose in its map, as RViz's 2D Pose Estimate does."""

    x: Coordinate  # [m]
    y: Coordinate  # [m]
    yaw: Angle | None = None  # [rad]; None for any
    covariance: Annotated[tuple[Finite, ...], Meta(max_length=9)] = ()
    # of x, y, yaw, 9 values by row; empty: that of what a person says
    source: Name = "anonymous"

    def __post_init__(self) -> None:
        if len(self.covariance) not in (0, 9):
            raise ValueError(f"covariance needs 9 values or none, got {len(self.covariance)}")


class PoseReply(Message, frozen=True, kw_only=True):
    """The answer to a PoseRequest. It is `ok` if the robot is looked for there."""

    ok: bool
    text: Text  # a sentence for people


class DescribeRequest(Message, frozen=True, kw_only=True):
    """Ask a process for its description. The request may be empty."""


# Asks who else has its name; works; has asked again for some seconds.
Claim = Literal["starting", "working", "settled"]


class Description(Message, frozen=True, kw_only=True):
    """A process, and figures that only it knows."""

    process: Name
    pid: Count
    host: Name
    version: Name
    publishes: Keys = ()
    subscribes: Keys = ()
    instance: Count = 0  # drawn at random at each start
    claim: Claim = "settled"  # to its name
    report: Annotated[dict[Key, Finite | Figure | Text | None], Meta(max_length=256)] = field(
        default_factory=dict
    )
    # of a simulation: its truth, for reports only


class ParamRequest(Message, frozen=True, kw_only=True):
    """Change a parameter of a running process. An empty request only lists all."""

    name: Name = ""  # of the parameter to change
    value: Text = ""  # as people type it
    source: Name = "anonymous"


class Param(Record, frozen=True, kw_only=True):
    """A parameter that may change while a process runs."""

    name: Name
    value: Text  # as it is now
    expected: Text  # what it may be, in words
    key: Name = ""  # its dotted place in a deployment file; empty if it has none
    initial: Text = ""  # its value when the process started


class ParamReply(Message, frozen=True, kw_only=True):
    """The result of a change, and all parameters."""

    ok: bool
    text: Text  # a sentence for people
    params: Annotated[tuple[Param, ...], Meta(max_length=256)] = ()
