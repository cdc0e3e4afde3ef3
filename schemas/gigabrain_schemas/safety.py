"""What safety says, how processes are doing, and what they log."""

from typing import Literal

from msgspec import field

from gigabrain_schemas.base import Cause, Count, Message, Name, NonNegative, Record, Text


class SpeedCaps(Record, frozen=True, kw_only=True):
    """How fast the body may go in each direction now; None where nothing limits it."""

    forward: NonNegative | None = None  # [m/s]
    backward: NonNegative | None = None  # [m/s]
    left: NonNegative | None = None  # [m/s]
    right: NonNegative | None = None  # [m/s]
    rotation: NonNegative | None = None  # [rad/s], either way
    turn_left: NonNegative | None = None  # [rad/s], where turning one way is the danger
    turn_right: NonNegative | None = None  # [rad/s]


class SafetyState(Message, frozen=True, kw_only=True):
    """The verdict of the safety process. The gate obeys it, and stops when it falls silent."""

    verdict: Literal["ok", "slow", "stop"]
    caps: SpeedCaps = SpeedCaps()
    causes: tuple[Cause, ...] = ()  # why the verdict is what it is
    warnings: tuple[Cause, ...] = ()  # what will become a cause if nobody acts


class Health(Message, frozen=True, kw_only=True):
    """How one process is doing, once a second."""

    process: Name
    pid: Count
    host: Name
    uptime_s: NonNegative
    cpu: NonNegative  # of one core, since the last report
    rss_bytes: Count
    received_hz: dict[str, NonNegative]  # per key, since the last report
    sent_hz: dict[str, NonNegative]
    rejected: dict[str, Count]  # per key, since the start
    latency_ms: dict[str, NonNegative]  # named figures, since the last report
    counters: dict[str, Count]  # named counts, since the start


class LogRecord(Message, frozen=True, kw_only=True):
    """One line of a process's log."""

    process: Name
    level: Literal["debug", "info", "warning", "error", "critical"]
    event: Name
    text: Text
    data: dict[str, str] = field(default_factory=dict)
