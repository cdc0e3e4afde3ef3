"""The state of safety, of an e-stop button, of each process, and its log."""

from typing import Annotated, Literal

from msgspec import Meta, field

from gigabrain_schemas.base import (
    Cause,
    Causes,
    Count,
    JointName,
    Key,
    Message,
    Name,
    NonNegative,
    Record,
    SpeedCap,
    Text,
)
from gigabrain_schemas.body import MAX_ARM_JOINTS

Figures = Annotated[dict[Key, NonNegative], Meta(max_length=256)]
Data = Annotated[str, Meta(max_length=4096)]
Counts = Annotated[dict[Key, Count], Meta(max_length=256)]


class SpeedCaps(Record, frozen=True, kw_only=True):
    """Greatest speeds in each direction now; None for no limit."""

    forward: SpeedCap | None = None  # [m/s]
    backward: SpeedCap | None = None  # [m/s]
    left: SpeedCap | None = None  # [m/s]
    right: SpeedCap | None = None  # [m/s]
    rotation: SpeedCap | None = None  # [rad/s], either way
    turn_left: SpeedCap | None = None  # [rad/s], where turning one way is the danger
    turn_right: SpeedCap | None = None  # [rad/s]


class JointCap(Record, frozen=True, kw_only=True):
    """Greatest speeds of a joint each way now, away from and towards what it must not touch."""

    name: JointName
    rise: SpeedCap | None = None  # [rad/s] or [m/s]; None for no limit
    fall: SpeedCap | None = None  # [rad/s] or [m/s], of a position that decreases


class SafetyState(Message, frozen=True, kw_only=True):
    """The verdict of the safety process. The gate obeys it, and stops when it falls silent."""

    verdict: Literal["ok", "slow", "stop"]
    caps: SpeedCaps = SpeedCaps()
    joints: Annotated[tuple[JointCap, ...], Meta(max_length=MAX_ARM_JOINTS)] = ()
    # of those that have a limit
    causes: Causes = ()  # why the verdict is what it is
    warnings: Causes = ()  # become causes if no one acts


class Health(Message, frozen=True, kw_only=True):
    """Health of one process, once a second."""

    process: Name
    pid: Count
    host: Name
    uptime_s: NonNegative
    cpu: NonNegative  # of one core, since the last report
    rss_bytes: Count
    received_hz: Figures  # per key, since the last report
    sent_hz: Figures
    rejected: Counts  # per key, since the start
    latency_ms: Figures  # named figures, since the last report
    counters: Counts  # named counts, since the start
    problems: Annotated[tuple[Cause, ...], Meta(max_length=16)] = ()  # what it cannot do now


class LogRecord(Message, frozen=True, kw_only=True):
    """One line of a process's log."""

    process: Name
    level: Literal["debug", "info", "warning", "error", "critical"]
    event: Name
    text: Text
    data: Annotated[dict[Key, Data], Meta(max_length=64)] = field(default_factory=dict)


class ButtonState(Message, frozen=True, kw_only=True):
    """State of an e-stop button. Where one is required, its silence counts as a press."""

    pressed: bool  # also when nothing is known of the contact
    text: Text = ""  # why it counts as pressed
