"""State of safety and of an e-stop button, health of processes, and log records."""

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
    """Present maximum speed in each direction; None for no limit."""

    forward: SpeedCap | None = None  # [m/s]
    backward: SpeedCap | None = None  # [m/s]
    left: SpeedCap | None = None  # [m/s]
    right: SpeedCap | None = None  # [m/s]
    rotation: SpeedCap | None = None  # [rad/s], in both directions
    turn_left: SpeedCap | None = None  # [rad/s], if only one direction is limited
    turn_right: SpeedCap | None = None  # [rad/s]


class JointCap(Record, frozen=True, kw_only=True):
    """Present maximum speeds of a joint in both directions."""

    name: JointName
    rise: SpeedCap | None = None  # [rad/s] or [m/s], as the position increases; None for no limit
    fall: SpeedCap | None = None  # [rad/s] or [m/s], as the position decreases


class SafetyState(Message, frozen=True, kw_only=True):
    """The verdict of the safety process. The gate obeys it, and stops without it."""

    verdict: Literal["ok", "slow", "stop"]
    caps: SpeedCaps = SpeedCaps()
    # joints with a limit
    joints: Annotated[tuple[JointCap, ...], Meta(max_length=MAX_ARM_JOINTS)] = ()
    causes: Causes = ()  # reasons of the verdict
    warnings: Causes = ()  # they become causes if nobody acts


class Health(Message, frozen=True, kw_only=True):
    """Health of one process, once a second."""

    process: Name
    pid: Count
    host: Name
    uptime_s: NonNegative
    cpu: NonNegative  # share of one core, since the last report
    rss_bytes: Count
    received_hz: Figures  # per key, since the last report
    sent_hz: Figures
    rejected: Counts  # per key, since the start
    latency_ms: Figures  # named figures, since the last report
    counters: Counts  # named counts, since the start
    problems: Annotated[tuple[Cause, ...], Meta(max_length=16)] = ()  # present ones


class LogRecord(Message, frozen=True, kw_only=True):
    """One line of a process's log."""

    process: Name
    level: Literal["debug", "info", "warning", "error", "critical"]
    event: Name
    text: Text
    data: Annotated[dict[Key, Data], Meta(max_length=64)] = field(default_factory=dict)


class ButtonState(Message, frozen=True, kw_only=True):
    """State of an e-stop button. If a button is required, its silence counts as a press."""

    pressed: bool  # also True if the contact is unknown
    text: Text = ""  # why it counts as pressed
