"""One realistic example of every message: what the golden files hold, and what tests start from."""

import struct
from typing import TypeVar

from gigabrain_schemas.audit import AuditPage, AuditRecord, AuditRequest
from gigabrain_schemas.base import Cause, Message, Pose, Velocity
from gigabrain_schemas.body import (
    Battery,
    Body,
    BodyDescription,
    ControlGains,
    GateStatus,
    Joint,
    Lidar,
    LinkHealth,
    RobotState,
    Thresholds,
)
from gigabrain_schemas.brain import (
    ActuationModel,
    CmdVel,
    Intent,
    JointCommand,
    JointTarget,
    Obstacle,
    OccupancyGrid,
    PoseInMap,
    TrajectoryPoint,
    Twist,
    WorldModel,
)
from gigabrain_schemas.input_log import WAITED, AcceptedRequest, ConsumedInput, InputLog
from gigabrain_schemas.requests import (
    DescribeRequest,
    Description,
    EnableRequest,
    EstopRequest,
    GateReply,
    MapReply,
    MapRequest,
    Param,
    ParamReply,
    ParamRequest,
    ReleaseRequest,
)
from gigabrain_schemas.safety import ButtonState, Health, LogRecord, SafetyState, SpeedCaps
from gigabrain_schemas.sensors import Image, Imu, ImuData, LaserScan
from gigabrain_schemas.tasks import (
    Goal,
    GoalReply,
    GoalRequest,
    MissionReply,
    MissionRequest,
    Task,
    TaskReply,
    TaskRequest,
    TaskStatus,
)

M = TypeVar("M", bound=Message)

STAMP_NS = 1_767_225_600_000_000_000  # 2026-01-01
BOOT = 81_985_529_216_486_895

ZONE = Cause(
    code="zone_ahead",
    text="obstacle 0.14 m ahead of the body",
    remedy="turn or back away, or clear the way",
)
LOW = Cause(code="battery_low", text="battery at 14 %", remedy="charge it soon")
FULL = Cause(code="map_full", text="the map is full", remedy="map in parts")
GATE = GateStatus(
    mode="enabled", causes=(ZONE,), estop_generation=2, commander="control", enables=3
)
IMU_DATA = ImuData(
    orientation=(0.0, 0.0, 0.0872, 0.9962),
    angular_velocity=(0.001, -0.002, -0.5),
    linear_acceleration=(0.02, 0.1, 9.81),
)

SENSORS: tuple[Message, ...] = (
    LaserScan(
        stamp_ns=STAMP_NS, seq=41, boot=BOOT, tick=205, basis=205,
        angle_min=0.0,
        angle_increment=0.7853982,
        range_min=0.12,
        range_max=3.5,
        ranges=struct.pack(
            "<8f", 0.83, 1.25, 3.49, float("inf"), float("inf"), float("nan"), 2.5, 0.9
        ),
    ),
    Imu(
        stamp_ns=STAMP_NS, seq=410, boot=BOOT, tick=205, basis=205,
        orientation=IMU_DATA.orientation,
        angular_velocity=IMU_DATA.angular_velocity,
        linear_acceleration=IMU_DATA.linear_acceleration,
    ),
    Image(
        stamp_ns=STAMP_NS, seq=61, boot=BOOT, tick=205, basis=205,
        frame_id="camera_depth_frame",
        encoding="depth16",
        height=2,
        width=3,
        data=struct.pack("<6H", 0, 830, 835, 1250, 1255, 65535),
    ),
)  # fmt: skip

BODY: tuple[Message, ...] = (
    RobotState(
        stamp_ns=STAMP_NS, seq=205, boot=BOOT, tick=205, basis=205,
        robot_type="turtlebot3_waffle",
        pose=Pose(x=0.41, y=-0.02, yaw=0.175),
        velocity=Velocity(linear_x=0.198, linear_y=0.001, angular_z=-0.5),
        sent=Velocity(linear_x=0.2, linear_y=0.0, angular_z=-0.52),
        joints=(
            Joint(
                name="wheel_left_joint", position=12.4, velocity=3.83, effort=0.11,
                temperature=31.5,
            ),
            Joint(
                name="wheel_right_joint", position=12.1, velocity=8.17, effort=0.14,
                temperature=32.0,
            ),
        ),
        battery=Battery(voltage=11.8, percentage=82.5, current=0.65),
        imu=IMU_DATA,
        bumpers=(False, True),
        link=LinkHealth(connected=True, age_ms=4.2, late_ms=0.3, errors=1, reconnects=1),
        gate=GATE,
    ),
    Body(
        stamp_ns=STAMP_NS, seq=5, boot=BOOT, tick=205, basis=205,
        description=BodyDescription(
            robot_type="turtlebot3_waffle",
            drive_type="differential",
            footprint=((0.077, 0.153), (-0.204, 0.153), (-0.204, -0.153), (0.077, -0.153)),
            max_linear_speed=0.26,
            max_lateral_speed=0.0,
            max_angular_speed=1.82,
            max_linear_acceleration=1.0,
            max_linear_deceleration=1.0,
            max_angular_acceleration=3.0,
            wheel_separation=0.287,
            max_rim_speed=0.26,
            lidar=Lidar(beams=360, rate_hz=10.0, range_min=0.12, range_max=3.5, x=-0.064),
            thresholds=Thresholds(),
            control=ControlGains(),
            safe_state="stop",
        ),
        link="sim",
    ),
)  # fmt: skip

BRAIN: tuple[Message, ...] = (
    WorldModel(
        stamp_ns=STAMP_NS, seq=41, boot=BOOT, tick=206, basis=205,
        scan_ok=True,
        scan_problem="",
        obstacle_ahead=True,
        distance_ahead=0.83,
        sectors=(0.83, 1.25, 3.49, None, 2.5, 0.9),
        obstacles=(
            Obstacle(
                id=7, x=1.2, y=0.4, velocity_x=-0.3, velocity_y=0.05, radius=0.25,
                covariance=(
                    0.01, 0.0, 0.0, 0.0,
                    0.0, 0.01, 0.0, 0.0,
                    0.0, 0.0, 0.04, 0.0,
                    0.0, 0.0, 0.0, 0.04,
                ),
            ),
        ),
        hits=struct.pack("<4f", 0.83, 0.0, -0.5, 1.25),
    ),
    PoseInMap(
        stamp_ns=STAMP_NS, seq=41, boot=BOOT, tick=206, basis=205,
        x=3.41, y=1.98, yaw=1.746,
        covariance=(0.0004, 0.0, 0.0, 0.0, 0.0004, 0.0, 0.0, 0.0, 0.0001),
        localized=True,
    ),
    OccupancyGrid(
        stamp_ns=STAMP_NS, seq=4, boot=BOOT, tick=206, basis=205,
        resolution=0.05,
        width=4,
        height=2,
        origin_x=-10.0,
        origin_y=-10.0,
        cells=bytes((0, 0, 100, 255, 0, 37, 100, 255)),
    ),
    Intent(
        stamp_ns=STAMP_NS, seq=205, boot=BOOT, tick=206, basis=205,
        twist=Velocity(linear_x=0.0, linear_y=0.0, angular_z=-0.5),
        joints=(JointTarget(name="camera_tilt_joint", position=0.2),),
        trajectory=(
            TrajectoryPoint(t=0.5, x=0.0, y=0.0, yaw=-0.25, angular_z=-0.5),
            TrajectoryPoint(t=1.0, x=0.0, y=0.0, yaw=-0.5, angular_z=-0.5),
        ),
        follow=True,
        response=ActuationModel(delay=0.04, lag=0.1),
        progress=0.4,
        behaviour="avoid",
        reason="turning right: obstacle 0.83 m ahead",
    ),
    Twist(
        stamp_ns=STAMP_NS, seq=12, boot=BOOT, tick=205, basis=0,
        linear_x=0.2, linear_y=0.0, angular_z=0.1,
    ),
    CmdVel(
        stamp_ns=STAMP_NS, seq=205, boot=BOOT, tick=206, basis=205,
        linear_x=0.18, linear_y=0.0, angular_z=-0.5, source="control",
    ),
    JointCommand(
        stamp_ns=STAMP_NS, seq=205, boot=BOOT, tick=206, basis=205,
        name=("camera_pan_joint", "camera_tilt_joint"), position=(0.0, 0.2), source="control",
    ),
)  # fmt: skip

SAFETY: tuple[Message, ...] = (
    ButtonState(
        stamp_ns=STAMP_NS, seq=40, boot=BOOT, tick=206, pressed=True, text="the contact is open"
    ),
    SafetyState(
        stamp_ns=STAMP_NS, seq=103, boot=BOOT, tick=206, basis=205,
        verdict="slow",
        caps=SpeedCaps(
            forward=0.0, backward=0.26, left=0.1, right=0.1,
            rotation=1.0, turn_left=0.5, turn_right=0.7,
        ),
        causes=(ZONE,),
        warnings=(LOW,),
    ),
    Health(
        stamp_ns=STAMP_NS, seq=4, boot=BOOT, tick=206, basis=0,
        process="perception",
        pid=4711,
        host="waffle",
        uptime_s=4.1,
        cpu=0.031,
        rss_bytes=48_300_032,
        received_hz={"robot/scan": 10.0, "robot/body": 1.0},
        sent_hz={"robot/world": 10.0},
        rejected={"robot/scan": 1},
        latency_ms={"scan_to_world_p50": 0.21},
        counters={"blind_scans": 0},
        problems=(FULL,),
    ),
    LogRecord(
        stamp_ns=STAMP_NS, seq=9, boot=BOOT, tick=206, basis=0,
        process="decision",
        level="info",
        event="decision",
        text="turning right: obstacle 0.83 m ahead",
        data={"reason": "obstacle ahead"},
    ),
)  # fmt: skip

REFUSED = AuditRecord(
    stamp_ns=STAMP_NS, seq=9, boot=BOOT, tick=206,
    process="driver",
    what="refused",
    source="script-4711",
    ok=False,
    code="commander",
    text="its commands are not obeyed (commander); control drives",
    times=50,
)  # fmt: skip
AUDIT: tuple[Message, ...] = (REFUSED, AuditRequest(newest=20), AuditPage(records=(REFUSED,)))

REQUESTS: tuple[Message, ...] = (
    EstopRequest(stamp_ns=STAMP_NS, seq=1, source="operator", reason="a child runs in"),
    ReleaseRequest(stamp_ns=STAMP_NS, seq=1, estop_generation=2, source="operator"),
    EnableRequest(stamp_ns=STAMP_NS, seq=1, source="control", take=True, by="ann"),
    GateReply(
        stamp_ns=STAMP_NS, seq=1, boot=BOOT, tick=205,
        ok=True, text="control holds the body", robot_type="turtlebot3_waffle", gate=GATE,
    ),
    MapRequest(name="office", replace=True, source="ann"),
    MapReply(ok=True, text="office.yaml is saved: 9.6 x 7.2 m, 41 m² free"),
    ParamRequest(stamp_ns=STAMP_NS, seq=1, name="linear_speed", value="0.15", source="ann"),
    ParamReply(
        stamp_ns=STAMP_NS, seq=1, boot=BOOT, tick=205,
        ok=True,
        text="linear_speed is 0.15 now, it was 0.2",
        params=(Param(name="linear_speed", value="0.15", expected="above 0, up to 10 m/s"),),
    ),
    DescribeRequest(),
    Description(
        process="driver",
        pid=4710,
        host="waffle",
        version="0.1.0",
        publishes=("robot/scan", "robot/state"),
        subscribes=("robot/cmd_vel", "robot/safety"),
        report={"distance_m": 11.4, "contacts": 0, "world": "arena", "min_clearance_m": None},
    ),
)  # fmt: skip

PATROL = Task(
    id="mission-4", kind="mission", label="evening round", source="ann", state="paused",
    reason="until goal-7 is done",
)  # fmt: skip
TASKS: tuple[Message, ...] = (
    GoalRequest(stamp_ns=STAMP_NS, seq=1, x=3.0, y=1.5, yaw=1.571, how="preempt", source="ann"),
    GoalReply(ok=True, text="on the way, 4.2 m", goal="goal-7"),
    MissionRequest(
        mission="places: {kitchen: [3, 1.5]}\ndo:\n- goto: kitchen\n- wait: 5\n",
        how="queue",
        source="ann",
        label="tea",
    ),
    MissionReply(ok=False, text="mission:2: do[0].goto: no place 'kitchen'"),
    TaskRequest(stamp_ns=STAMP_NS, seq=1, do="cancel", task="goal-7", source="ann"),
    TaskReply(ok=True, text="goal-7 is cancelled", task="goal-7"),
    AcceptedRequest(
        stamp_ns=STAMP_NS, seq=3, boot=BOOT, tick=205, basis=200,
        process="decision", service="robot/goal",
        request='{"x":3.0,"y":1.5,"how":"preempt","source":"ann"}',
    ),
    TaskStatus(
        stamp_ns=STAMP_NS, seq=91, boot=BOOT, tick=206, basis=205,
        current=Task(
            id="goal-7", kind="goal", label="(3.00, 1.50)", source="ann", state="active",
            reason="going round something",
        ),
        doing="going to (3.00, 1.50)",
        drives=True,
        progress=0.25,
        distance_remaining=3.15,
        eta=15.8,
        goal=Goal(x=3.0, y=1.5, yaw=1.571),
        path=((0.41, -0.02), (1.4, 0.6), (3.0, 1.5)),
        queue=(PATROL,),
        done=(
            Task(
                id="goal-6", kind="goal", label="(0.00, 0.00)", source="page", state="failed",
                reason="gave up: no progress for 30 s, 0.40 m from the goal",
                position_error=0.4, heading_error=0.05,
            ),
        ),
    ),
)  # fmt: skip

HEARD: tuple[Message, ...] = (
    InputLog(
        stamp_ns=STAMP_NS, seq=4, boot=BOOT, tick=206, basis=0, began_ns=STAMP_NS - 500_000_000,
        keys=("robot/state", "robot/scan", WAITED),
        taken=(
            ConsumedInput(0, 205, 0), ConsumedInput(1, 41, 1250), ConsumedInput(2, 1, 2100),
            ConsumedInput(0, 206, 20_020),
        ),
    ),
)  # fmt: skip

EXAMPLES: dict[str, Message] = {
    type(message).__name__: message
    for message in (*SENSORS, *BODY, *BRAIN, *SAFETY, *AUDIT, *REQUESTS, *TASKS, *HEARD)
}  # fmt: skip


def example(kind: type[M]) -> M:
    """The example of one message type."""
    message = EXAMPLES[kind.__name__]
    assert isinstance(message, kind)
    return message
