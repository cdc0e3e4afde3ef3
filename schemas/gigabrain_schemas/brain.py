"""Messages of perception, decision and control."""

from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec import Meta

from gigabrain_schemas.base import (
    Angle,
    AngularSpeed,
    Coordinate,
    Count,
    Distance,
    Finite,
    Fraction,
    JointName,
    LinearSpeed,
    Message,
    Name,
    Record,
    Text,
    Tick,
    Velocity,
    array_meta,
)
from gigabrain_schemas.body import MAX_ARM_JOINTS, MAX_CAMERAS, JointPosition, JointSpeed
from gigabrain_schemas.sensors import Quaternion

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

FARTHEST_HIT = 1000.0  # [m], maximum of |x| and of |y|
Resolution = Annotated[float, Meta(ge=0.001, le=1.0)]  # [m] per cell
Cells = Annotated[int, Meta(ge=0, le=100_000)]  # number along one side of a map
Delay = Annotated[float, Meta(ge=0.0, le=10.0)]  # [s]


class Obstacle(Record, frozen=True, kw_only=True):
    """An obstacle that perception tracks from scan to scan."""

    id: Count
    x: Coordinate  # [m], in the odometry's frame
    y: Coordinate  # [m]
    velocity_x: LinearSpeed = 0.0  # [m/s]
    velocity_y: LinearSpeed = 0.0  # [m/s]
    radius: Annotated[float, Meta(ge=0.0, le=10.0)]  # [m]
    # of (x, y, velocity_x, velocity_y), 16 values by row
    covariance: Annotated[tuple[Finite, ...], Meta(max_length=16)] = ()

    def __post_init__(self) -> None:
        if len(self.covariance) not in (0, 16):
            raise ValueError(f"covariance needs 16 values or none, got {len(self.covariance)}")


class DetectedObject(Obstacle, frozen=True, kw_only=True):
    """An object that a perceptor found."""

    label: Name  # class, such as person
    confidence: Fraction = 1.0
    avoid: bool = False  # the planner avoids it like an obstacle


class Objects(Message, frozen=True, kw_only=True):
    """The objects that a perceptor finds in one scan. The basis is the tick of that scan."""

    objects: Annotated[tuple[DetectedObject, ...], Meta(max_length=256)]


Height = Annotated[float, Meta(ge=-10.0, le=10.0)]  # [m] above the floor
Corner = tuple[Coordinate, Coordinate]


class Contour(Record, frozen=True, kw_only=True):
    """The outline of an object that a camera saw on the floor, or of a hole in the floor.

    A hole, such as a step down, has a negative `bottom`.
    """

    polygon: Annotated[tuple[Corner, ...], Meta(min_length=3, max_length=64)]
    # [m], in the body's frame, counter-clockwise
    bottom: Height  # [m] above the floor
    top: Height  # [m]
    age: Annotated[float, Meta(ge=0.0, le=1e6)] = 0.0  # [s] since it was last seen
    confidence: Fraction = 1.0
    track: Count = 0  # number that stays the same from picture to picture
    source: Literal["depth", "floor_colour"] = "depth"  # floor_colour measures no height

    def __post_init__(self) -> None:
        if self.top < self.bottom:
            raise ValueError("top must not be below bottom")


class CameraStatus(Record, frozen=True, kw_only=True):
    """The health of a camera. It is `ok` while its pictures are plausible."""

    name: Name
    ok: bool
    problem: Text = ""  # why it is not ok: covered, frozen, no picture
    exposure: Tick = 0  # tick of the newest picture with contours in the world; 0 for none


class WorldModel(Message, frozen=True, kw_only=True):
    """The robot's present surroundings, in the body's frame."""

    scan_ok: bool
    scan_problem: Text = ""  # why the scan is not plausible
    obstacle_ahead: bool  # also true while unknown
    distance_ahead: Distance | None = None  # [m] to the nearest hit ahead; None: none or unknown
    sectors: Annotated[tuple[Distance | None, ...], Meta(max_length=3600)] = ()
    # [m], nearest hit per equal sector, counter-clockwise, the first centred ahead; None: no hit
    obstacles: Annotated[tuple[Obstacle, ...], Meta(max_length=256)] = ()
    contours: Annotated[tuple[Contour, ...], Meta(max_length=128)] = ()
    cameras: Annotated[tuple[CameraStatus, ...], Meta(max_length=MAX_CAMERAS)] = ()
    # float32 little-endian [m], (n, 2): points that beams hit; for navigation only
    hits: Annotated[bytes, array_meta(64 * 1024, "float32", ("n", 2), "m")] = b""

    def __post_init__(self) -> None:
        if len(self.hits) % 8:
            raise ValueError(f"hits must be pairs of float32, got {len(self.hits)} bytes")

    def points(self) -> "NDArray[np.float32]":
        """Return the points that beams hit [m], (n, 2) in the body's frame.

        Points with NaN, infinity or coordinates beyond FARTHEST_HIT are left out.
        """
        import numpy as np

        points = np.frombuffer(self.hits, "<f4").reshape(-1, 2)
        near = np.abs(points) <= FARTHEST_HIT
        return points if near.all() else points[near.all(axis=1)]


class PoseInMap(Message, frozen=True, kw_only=True):
    """The robot's pose in the map, with its covariance."""

    x: Coordinate  # [m]
    y: Coordinate  # [m]
    yaw: Angle  # [rad]
    covariance: Annotated[tuple[Finite, ...], Meta(min_length=9, max_length=9)]  # of x, y, yaw
    localized: bool = True


CELL_VALUES = bytes((*range(101), 255))  # as int8: 0 to 100, and -1


class OccupancyGrid(Message, frozen=True, kw_only=True):
    """A map. The last value is kept for late joiners."""

    resolution: Resolution  # [m] per cell
    width: Cells  # cells
    height: Cells  # cells
    origin_x: Coordinate  # [m], of the corner of cell (0, 0)
    origin_y: Coordinate  # [m]
    # int8, (height, width) by row: 0 free to 100 occupied, -1 unknown
    cells: Annotated[bytes, array_meta(8 * 1024 * 1024, "int8", ("height", "width"))]

    def __post_init__(self) -> None:
        if len(self.cells) != self.width * self.height:
            raise ValueError(f"{self.width} x {self.height} cells but {len(self.cells)} bytes")
        if self.cells.translate(None, CELL_VALUES):
            raise ValueError("a cell is 0 to 100, or -1")

    def array(self) -> "NDArray[np.int8]":
        """Return the cells, (height, width), as a read-only view."""
        import numpy as np

        return np.frombuffer(self.cells, "i1").reshape(self.height, self.width)


class TrajectoryPoint(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """An expected state of the body, in its frame at the tick of the intent's basis."""

    t: Annotated[float, Meta(ge=0.0, le=60.0)]  # [s] from that tick
    x: Coordinate  # [m]
    y: Coordinate  # [m]
    yaw: Angle  # [rad]
    linear_x: LinearSpeed = 0.0  # [m/s], in the body's frame at `t`
    linear_y: LinearSpeed = 0.0  # [m/s]
    angular_z: AngularSpeed = 0.0  # [rad/s]


class ActuationModel(Record, frozen=True, kw_only=True):
    """Response of a body to a commanded velocity: a delay, then a first-order lag."""

    delay: Delay = 0.0  # [s]
    lag: Delay = 0.0  # [s], time constant
    turn_gain: Annotated[float, Meta(ge=0.01, le=100.0)] = (
        1.0  # of the turn rate: measured over commanded
    )


class JointTarget(Record, frozen=True, kw_only=True):
    """The desired position of one joint."""

    name: JointName
    position: JointPosition  # [rad] or [m]


LONGEST_WINDOW_S = 3.0  # maximum duration of a joint trajectory in an intent


class JointTrajectory(Record, frozen=True, kw_only=True):
    """The desired positions of joints over time: a window that decision keeps renewing.

    Positions between the points are interpolated; after the last point the joints stay.
    """

    name: Annotated[tuple[JointName, ...], Meta(min_length=1, max_length=MAX_ARM_JOINTS)]
    start: Tick  # tick of the first point
    period: Annotated[float, Meta(ge=0.001, le=1.0)]  # [s] from point to point
    # float32 little-endian [rad] or [m], (n, joints)
    positions: Annotated[bytes, array_meta(12 * 1024, "float32", ("n", "joints"), "rad")]

    def __post_init__(self) -> None:
        joints = len(self.name)
        count, rest = divmod(len(self.positions), 4 * joints)
        if rest or not count:
            raise ValueError(f"positions: expected rows of {joints} float32")
        if (count - 1) * self.period > LONGEST_WINDOW_S + 1e-9:
            raise ValueError(f"positions: they may last {LONGEST_WINDOW_S:g} s")
        import numpy as np

        if not np.isfinite(self.array()).all():
            raise ValueError("positions: expected finite numbers")
        if len(set(self.name)) < joints:
            raise ValueError("name: each joint at most once")

    def array(self) -> "NDArray[np.float32]":
        """Return the positions [rad] or [m], (n, joints), as a read-only view."""
        import numpy as np

        return np.frombuffer(self.positions, "<f4").reshape(-1, len(self.name))


class Intent(Message, frozen=True, kw_only=True):
    """Decision's output: the desired motion, its expected trajectory, and the reason."""

    twist: Velocity | None = None
    joints: Annotated[tuple[JointTarget, ...], Meta(max_length=MAX_ARM_JOINTS)] = ()
    joint_trajectory: JointTrajectory | None = None  # instead of `joints`
    trajectory: Annotated[tuple[TrajectoryPoint, ...], Meta(max_length=256)] = ()
    follow: bool = False  # control follows the trajectory; otherwise it commands the twist
    response: ActuationModel = ActuationModel()  # model of the body behind the trajectory
    progress: Fraction = 0.0  # share of the present step that is done
    behaviour: Name
    reason: Text  # a sentence for people


class GraspPose(Record, frozen=True, kw_only=True):
    """A pose of fingers that may hold an object: they approach along x and close along z."""

    position: tuple[Coordinate, Coordinate, Coordinate]  # [m], between them, in the body's frame
    orientation: Quaternion  # x, y, z, w
    opening: Annotated[float, Meta(gt=0.0, le=10.0)]  # [m], between the fingers at the object


class ArmPlan(Message, frozen=True, kw_only=True):
    """The planned path of an arm's tool, for viewers. It is empty once the arm has arrived."""

    # float32 little-endian [m], (n, 3) in the body's frame
    path: Annotated[bytes, array_meta(12 * 1024, "float32", ("n", 3), "m")] = b""
    grasps: Annotated[tuple[GraspPose, ...], Meta(max_length=16)] = ()  # the chosen one first

    def __post_init__(self) -> None:
        if len(self.path) % 12:
            raise ValueError(f"path must be triples of float32, got {len(self.path)} bytes")

    def points(self) -> "NDArray[np.float32]":
        """Return the path [m], (n, 3), without points that are not finite."""
        import numpy as np

        points = np.frombuffer(self.path, "<f4").reshape(-1, 3)
        return np.asarray(points[np.isfinite(points).all(axis=1)])


class Twist(Message, frozen=True, kw_only=True):
    """A velocity that an operator requests."""

    linear_x: LinearSpeed  # [m/s]
    linear_y: LinearSpeed = 0.0  # [m/s]
    angular_z: AngularSpeed = 0.0  # [rad/s]
    source: Name = ""  # the operator; control follows one of them at a time


class JointSpeeds(Message, frozen=True, kw_only=True):
    """Velocities of joints that an operator requests; other joints are held."""

    name: Annotated[tuple[JointName, ...], Meta(min_length=1, max_length=MAX_ARM_JOINTS)]
    velocity: Annotated[tuple[JointSpeed, ...], Meta(max_length=MAX_ARM_JOINTS)]  # [rad/s] or [m/s]
    source: Name = ""  # the operator, as in Twist

    def __post_init__(self) -> None:
        if len(self.velocity) != len(self.name):
            raise ValueError(f"{len(self.name)} names and {len(self.velocity)} velocities")
        if len(set(self.name)) < len(self.name):
            raise ValueError("name: each joint at most once")


class CmdVel(Message, frozen=True, kw_only=True):
    """A command to the gate: a velocity of the body."""

    linear_x: LinearSpeed  # [m/s]
    linear_y: LinearSpeed = 0.0  # [m/s]
    angular_z: AngularSpeed = 0.0  # [rad/s]
    source: Name = ""  # of the command
    operator: bool = False  # control follows an operator's teleop stream, not decision's intent


class JointCommand(Message, frozen=True, kw_only=True):
    """A command to the gate: positions and velocities of joints for the next tick.

    With positions only, joints move there and stay. With velocities only, they keep moving.
    """

    name: Annotated[tuple[JointName, ...], Meta(min_length=1, max_length=MAX_ARM_JOINTS)]
    position: Annotated[tuple[JointPosition, ...], Meta(max_length=MAX_ARM_JOINTS)] = ()
    # [rad] or [m]
    velocity: Annotated[
        tuple[JointSpeed, ...], Meta(max_length=MAX_ARM_JOINTS)
    ] = ()  # [rad/s] or [m/s]
    source: Name = ""  # of the command
    operator: bool = False  # control follows an operator's stream, not decision's intent

    def __post_init__(self) -> None:
        count, lengths = len(self.name), (len(self.position), len(self.velocity))
        if lengths not in ((count, 0), (0, count), (count, count)):
            raise ValueError(
                f"{count} names need as many positions or velocities, or both, "
                f"got {lengths[0]} and {lengths[1]}"
            )
        if len(set(self.name)) < count:
            raise ValueError("name: each joint at most once")
