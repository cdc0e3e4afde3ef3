"""Compares a ROS 2 robot with its file: finds missing topics and other faults. Pure.

`explain` needs only the graph, for a driver's log; `findings` also needs messages.
"""

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from gigabrain_drivers.bodies.ros2 import options as ros2
from gigabrain_drivers.bodies.ros2.conversion import has_orientation, stamp_ns
from gigabrain_drivers.bodies.ros2.frames import FrameTree
from gigabrain_drivers.bodies.ros2.options import Ros2Options
from gigabrain_schemas.body import Lidar
from gigabrain_zenoh.geometry.pose import wrap_angle
from gigabrain_zenoh.ros2.graph import CLOCK_S, SYNCHRONISE, clock_text, unreached
from gigabrain_zenoh.ros2.qos import Qos, mismatch
from gigabrain_zenoh.ros2.transport import GraphEndpoint, absolute

MIN_RATE_SHARE = 0.8  # minimum rate, as a share of the rate in the robot's file
MAX_ERROR_M, MAX_ERROR_RAD = 0.02, 0.05  # between a mounting in the file and in /tf_static
SIM_TIME_S = 1e8  # smaller stamps are simulated time, not Unix time
MAX_NAMED = 4  # topics in one text
NO_TILT = (
    "it has no orientation (orientation_covariance[0] is -1), so tilt_stop cannot stop the robot"
)
ADD_ORIENTATION = (
    "have a filter add it, such as imu_filter_madgwick, and write its topic as topics.imu.name"
)

Verdict = Literal["ok", "warning", "error"]


class Finding(NamedTuple):
    """One line of the check."""

    what: str  # a topic or frame
    verdict: Verdict
    text: str  # the result
    remedy: str = ""


class Row(NamedTuple):
    """A topic that the robot's file names."""

    part: str  # its name in `topics:`
    topic: str  # absolute name
    type: str
    qos: Qos
    hz: float  # expected rate; 0: any


@dataclass
class TopicStatistics:
    """Statistics of a topic's messages during a watch."""

    count: int = 0
    seconds: float = 0.0  # from the first message to the last
    offset_s: float | None = None  # this machine's clock minus the newest stamp
    stamp_s: float = 0.0  # the newest stamp
    frame: str = ""
    child_frame: str = ""
    tilt: bool = True  # false: the messages of an IMU have no orientation
    unreadable: str = ""  # reason: a message could not be decoded
    unusable: str = ""  # reason: the driver drops the newest message

    @property
    def hz(self) -> float:
        """Rate of the messages."""
        return (self.count - 1) / self.seconds if self.seconds else 0.0

    def take(self, message: Any, unix_ns: int, elapsed_s: float) -> None:
        """Add a message, `elapsed_s` after the first."""
        self.count += 1
        self.seconds = elapsed_s
        header = getattr(message, "header", None)
        if header:
            self.stamp_s = stamp_ns(header.stamp) / 1e9
            self.offset_s = unix_ns / 1e9 - self.stamp_s
            self.frame = header.frame_id
        self.child_frame = getattr(message, "child_frame_id", "")
        if hasattr(message, "orientation_covariance"):
            self.tilt = has_orientation(message)


@dataclass
class Watched:
    """The results of watching a robot."""

    endpoints: tuple[GraphEndpoint, ...] = ()
    statistics: dict[str, TopicStatistics] = field(default_factory=dict)  # by part
    frames: FrameTree = field(default_factory=FrameTree)


def rows(options: Ros2Options, lidar: Lidar | None = None) -> list[Row]:
    """Return the topics that the robot's file expects."""
    topics = options.topics
    found = []
    for part, type, hz in (
        ("odometry", ros2.ODOMETRY, topics.odometry.hz),
        ("scan", ros2.SCAN, lidar.rate_hz if lidar else 0.0),
        ("imu", ros2.IMU, 0.0),
        ("battery", ros2.BATTERY, 0.0),
        ("joints", ros2.JOINTS, 0.0),
    ):
        if topic := getattr(topics, part):
            name = absolute(topic.name, options.namespace)
            found.append(Row(part, name, type, Qos(topic.qos == "reliable"), hz))
    if options.mounting == "tf_static":
        latched = Qos(transient_local=True)
        found.append(Row("mounting", ros2.TF_STATIC_TOPIC, ros2.TF, latched, 0.0))
    return found


def explain(options: Ros2Options, endpoints: Sequence[GraphEndpoint]) -> str:
    """Return up to two errors of the graph with remedies, as one line; empty without errors."""
    wrong = [f for f in graph_findings(options, endpoints) if f.verdict == "error"]
    return "; ".join(f"{each.what}: {each.text}; {each.remedy}" for each in wrong[:2])


def graph_findings(
    options: Ros2Options, endpoints: Sequence[GraphEndpoint], lidar: Lidar | None = None
) -> list[Finding]:
    """Return one finding or more about the graph for each topic."""
    others = [each for each in endpoints if not each.ours]
    if not others:
        router = str(options.router or options.port)
        do = unreached(options.transport, options.domain, router)
        return [Finding("graph", "error", "no other node is found", do)]
    return [
        *(_publisher_finding(row, others) for row in rows(options, lidar)),
        *_command_findings(options, others),
    ]


def _publisher_finding(row: Row, others: Sequence[GraphEndpoint]) -> Finding:
    publishers = [each for each in others if each.topic == row.topic and each.kind == "publisher"]
    if not publishers:
        return Finding(row.topic, "error", "it has no publisher", _suggestion(row, others))
    right = [each for each in publishers if each.type == row.type]
    if not right:
        return Finding(
            row.topic,
            "error",
            f"it is of type {publishers[0].type}; expected {row.type}",
            f"name the right topic in topics.{row.part}.name, or have {publishers[0].node} publish "
            "that type",
        )
    wrong = mismatch(right[0].qos, row.qos)
    if wrong:
        return Finding(
            row.topic,
            "error",
            f"no message can come: {wrong}",
            f"write topics: {{{row.part}: {{qos: best_effort}}}}"
            if row.part != "mounting"
            else "have its publisher use transient local, as robot_state_publisher does",
        )
    if len(right) > 1:
        names = ", ".join(sorted({each.node for each in right}))
        return Finding(row.topic, "warning", f"{len(right)} publishers: {names}", "end all but one")
    return Finding(row.topic, "ok", f"{row.type} of {right[0].node or 'a node'}, {right[0].qos}")


def _suggestion(row: Row, others: Sequence[GraphEndpoint]) -> str:
    """Return a remedy for a missing topic: names topics of its type, or one of a similar name."""
    publishers = [each for each in others if each.kind == "publisher"]
    same = sorted({each.topic for each in publishers if each.type == row.type})
    if same:
        named = ", ".join(same[:MAX_NAMED])
        return f"topics of that type: {named}; write it as topics.{row.part}.name, or set namespace"
    if row.part == "mounting":
        return "start robot_state_publisher on the robot, or write mounting: file"
    close = difflib.get_close_matches(row.topic, sorted({each.topic for each in publishers}), 1)
    like = f"{close[0]} is there; " if close else ""
    return f"{like}start the node that publishes it, or leave topics.{row.part} out"


def _command_findings(options: Ros2Options, others: Sequence[GraphEndpoint]) -> list[Finding]:
    command = options.topics.command
    topic = absolute(command.name, options.namespace)
    on_topic = [each for each in others if each.topic == topic]
    subscribers = [each for each in on_topic if each.kind == "subscriber"]
    right = [each for each in subscribers if each.type == command.type]
    offered = Qos(command.qos == "reliable")
    if not subscribers:
        kinds = (ros2.TWIST, ros2.TWIST_STAMPED)
        alternatives = sorted(
            {e.topic for e in others if e.kind == "subscriber" and e.type in kinds}
        )
        text = (
            f"topics that take one: {', '.join(alternatives[:MAX_NAMED])}; " if alternatives else ""
        )
        do = f"{text}start the robot's base node, or write topics.command.name"
        found = [Finding(topic, "error", "no node takes commands", do)]
    elif not right:
        do = f"write topics: {{command: {{type: {subscribers[0].type}}}}}"
        text = f"{subscribers[0].node} takes {subscribers[0].type}; expected {command.type}"
        found = [Finding(topic, "error", text, do)]
    elif wrong := mismatch(offered, right[0].qos):
        do = "write topics: {command: {qos: reliable}}"
        found = [Finding(topic, "error", f"no command can arrive: {wrong}", do)]
    else:
        found = [Finding(topic, "ok", f"{command.type} to {right[0].node or 'a node'}")]
    rivals = sorted({each.node for each in on_topic if each.kind == "publisher"})
    rivals = [node for node in rivals if not _is_ours(node, options)]
    if rivals:
        do = "stop that node: its commands bypass the gate"
        found.append(Finding(topic, "warning", f"commanded by {', '.join(rivals)} as well", do))
    return found


def _is_ours(node: str, options: Ros2Options) -> bool:
    """Return whether a node is our driver or its guard."""
    return node.rpartition("/")[2] in (options.node, f"{options.node}_guard")


def findings(options: Ros2Options, lidar: Lidar | None, watched: Watched) -> list[Finding]:
    """Return all findings after a watch: about the graph, messages, stamps and frames."""
    found = graph_findings(options, watched.endpoints, lidar)
    bad = {each.what for each in found if each.verdict == "error"}
    if any(each.what == "graph" for each in found):
        return found
    for row in rows(options, lidar):
        if row.topic not in bad and row.part != "mounting":
            found += _message_findings(row, watched.statistics.get(row.part) or TopicStatistics())
    if options.mounting == "tf_static" or len(watched.frames):
        found += _frame_findings(options, lidar, watched)
    return found


def _message_findings(row: Row, statistics: TopicStatistics) -> list[Finding]:
    if statistics.unreadable:
        do = "is it the same definition on the robot? Other distributions changed some"
        return [Finding(row.topic, "error", statistics.unreadable, do)]
    if statistics.unusable:
        do = f"correct topics.{row.part} in the file, or the node that publishes it"
        return [Finding(row.topic, "error", statistics.unusable, do)]
    if not statistics.count:
        do = "is its node alive, and the network between open for UDP both ways?"
        return [Finding(row.topic, "error", "its publisher is there, but no message came", do)]
    found = []
    if row.hz and statistics.hz < MIN_RATE_SHARE * row.hz:
        where = "topics.odometry.hz" if row.part == "odometry" else "rate_hz of `lidar:`"
        do = f"write what it does as {where}, or have the robot send as often"
        text = f"{statistics.hz:.1f} messages a second; expected {row.hz:g}"
        found.append(Finding(row.topic, "warning", text, do))
    if not statistics.tilt:
        found.append(Finding(row.topic, "warning", NO_TILT, ADD_ORIENTATION))
    if wrong := _clock_finding(row, statistics):
        found.append(wrong)
    if not found:
        found.append(Finding(row.topic, "ok", f"{statistics.hz:.1f} Hz, stamps of this clock"))
    return found


def _clock_finding(row: Row, statistics: TopicStatistics) -> Finding | None:
    if statistics.offset_s is None or abs(statistics.offset_s) <= CLOCK_S:
        return None
    if statistics.stamp_s == 0.0:
        return Finding(row.topic, "error", "its stamps are 0", "have its node fill in the header")
    if statistics.stamp_s < SIM_TIME_S:
        do = "set use_sim_time false on the robot; a simulation belongs on link sim or emulated"
        text = f"its stamps are of a simulation: {statistics.stamp_s:.1f} s"
        return Finding(row.topic, "error", text, do)
    do = f"{SYNCHRONISE}; TwistStamped commands look old otherwise"
    return Finding(row.topic, "warning", f"its stamps are {clock_text(statistics.offset_s)}", do)


def _frame_findings(options: Ros2Options, lidar: Lidar | None, watched: Watched) -> list[Finding]:
    """Return findings about frames: connected to the base, and mounted as the file says."""
    level: Verdict = "error" if options.mounting == "tf_static" else "warning"
    base, found = options.base_frame, list[Finding]()
    frame_of: dict[str, Callable[[TopicStatistics], str]] = {
        "odometry": lambda statistics: statistics.child_frame,
        "scan": lambda statistics: statistics.frame,
        "imu": lambda statistics: statistics.frame,
    }
    for part, frame in frame_of.items():
        statistics = watched.statistics.get(part)
        if not statistics or not statistics.count:
            continue
        name = frame(statistics)
        place = watched.frames.find(name, base)
        if place is None:
            known = ", ".join(watched.frames.names[:12]) or "none"
            text = f"{name!r} is not connected with {base!r}; frames of /tf_static: {known}"
            do = "write the robot's own base as base_frame, or publish the missing joint"
            found.append(Finding(f"{part} frame", level, text, do))
            continue
        x, y, yaw = place.planar
        text = f"{name} at x {x:.3f} m, y {y:.3f} m, yaw {yaw:.3f} rad of {base}"
        if part == "scan" and lidar and options.mounting == "file":
            off = max(abs(x - lidar.x), abs(y - lidar.y)), abs(wrap_angle(yaw - lidar.yaw))
            if off[0] > MAX_ERROR_M or off[1] > MAX_ERROR_RAD:
                do = "correct x, y and yaw of `lidar:`, or write mounting: tf_static"
                expected = f"the file says x {lidar.x:g}, y {lidar.y:g}, yaw {lidar.yaw:g}"
                found.append(Finding("scan frame", "warning", f"{text}; {expected}", do))
                continue
        found.append(Finding(f"{part} frame", "ok", text))
    return found
