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
    """Stop at once, and latch until a person releases the robot. The request may be empty."""

    source: Name = "anonymous"
    reason: Text = ""


class ReleaseRequest(Message, frozen=True, kw_only=True):
    """Release a latched gate. The robot moves only after an enable as well."""

    estop_generation: Count  # from robot/state, so that no newer e-stop is released
    source: Name = "anonymous"


class EnableRequest(Message, frozen=True, kw_only=True):
    """Let one source drive."""

    source: Name  # "control" for the robot's own brain
    take: bool = False  # also if another source drives
    by: Name = ""  # the person, if the source is the brain


class LimpRequest(Message, frozen=True, kw_only=True):
    """Switch the torque of all joints off, so that they may fall; or on again, to hold them."""

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
    ]  # of the files, without suffix
    replace: bool = False  # overwrite a map of that name
    source: Name = "anonymous"


class MapReply(Message, frozen=True, kw_only=True):
    """The result of saving a map, with its path."""

    ok: bool
    text: Text  # a sentence for people


class PoseRequest(Message, frozen=True, kw_only=True):
    """Localize the robot near a pose in its map, as RViz's 2D Pose Estimate does."""

    x: Coordinate  # [m]
    y: Coordinate  # [m]
    yaw: Angle | None = None  # [rad]; None for any
    # of x, y, yaw, 9 values by row; empty: that of a person's estimate
    covariance: Annotated[tuple[Finite, ...], Meta(max_length=9)] = ()
    source: Name = "anonymous"

    def __post_init__(self) -> None:
        if len(self.covariance) not in (0, 9):
            raise ValueError(f"covariance needs 9 values or none, got {len(self.covariance)}")


class PoseReply(Message, frozen=True, kw_only=True):
    """The answer to a PoseRequest. It is `ok` if localization starts there."""

    ok: bool
    text: Text  # a sentence for people


class DescribeRequest(Message, frozen=True, kw_only=True):
    """Ask a process for its description. The request may be empty."""


# starting: checks that its name is free; working: its name is free; settled: it has checked again
# for some seconds
Claim = Literal["starting", "working", "settled"]


class Description(Message, frozen=True, kw_only=True):
    """A process, with figures that only it knows."""

    process: Name
    pid: Count
    host: Name
    version: Name
    publishes: Keys = ()
    subscribes: Keys = ()
    instance: Count = 0  # random number of this start
    claim: Claim = "settled"  # state of the claim to its name
    # a simulation reports its ground truth here
    report: Annotated[dict[Key, Finite | Figure | Text | None], Meta(max_length=256)] = field(
        default_factory=dict
    )


class ParamRequest(Message, frozen=True, kw_only=True):
    """Change a parameter of a running process. An empty request only lists all."""

    name: Name = ""  # of the parameter to change
    value: Text = ""  # as text
    source: Name = "anonymous"


class Param(Record, frozen=True, kw_only=True):
    """A parameter that may change while a process runs."""

    name: Name
    value: Text  # the present one
    expected: Text  # allowed values, in words
    key: Name = ""  # dotted path in a deployment file; empty if it has none
    initial: Text = ""  # value at the start of the process


class ParamReply(Message, frozen=True, kw_only=True):
    """The result of a change, and all parameters."""

    ok: bool
    text: Text  # a sentence for people
    params: Annotated[tuple[Param, ...], Meta(max_length=256)] = ()
