"""Health and causes as diagnostic_msgs, as rqt_robot_monitor and Foxglove show them."""

from collections.abc import Iterable, Mapping
from enum import IntEnum
from typing import Any, NamedTuple

from gigabrain_schemas.base import Cause
from gigabrain_schemas.body import Battery, RobotState, Thresholds
from gigabrain_schemas.safety import Health, SafetyState
from gigabrain_zenoh.gateway.conversions.frames import Make, header

STALE_NS = 3_000_000_000  # health comes once a second


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK, WARN, ERROR, STALE = range(4)


class Status(NamedTuple):
    """One line of diagnostics."""

    name: str
    level: Level
    text: str
    values: Mapping[str, object] = {}


def of_process(health: Health, age_ns: int) -> Status:
    """Return the status of a process: WARN with problems, STALE when silent."""
    values = {
        "cpu": f"{health.cpu:.3f}",
        "rss_mb": f"{health.rss_bytes / 1e6:.0f}",
        "uptime_s": f"{health.uptime_s:.0f}",
        "host": health.host,
        "pid": health.pid,
        **{f"rejected {key}": count for key, count in health.rejected.items()},
        **{f"{name}_ms": f"{value:.2f}" for name, value in health.latency_ms.items()},
        **health.counters,
    }
    if age_ns > STALE_NS:
        return Status(health.process, Level.STALE, f"silent for {age_ns / 1e9:.0f} s", values)
    return _of_causes(health.process, health.problems, values, "runs")


def of_gate(state: RobotState | None) -> Status:
    """Return the status of the gate; causes that latch are errors."""
    if state is None:
        return Status("gate", Level.STALE, "no state from the robot; check that its driver runs")
    gate = state.gate
    values = {"mode": gate.mode, "commander": gate.commander, "estops": gate.estop_generation}
    return _of_causes("gate", gate.causes, values, f"{gate.mode} {gate.commander}".strip())


def of_safety(verdict: SafetyState | None) -> Status:
    """Return the status of safety; its verdict `stop` is an error."""
    if verdict is None:
        return Status("safety", Level.STALE, "no verdict; check that safety runs")
    text = _in_words((*verdict.causes, *verdict.warnings)) or verdict.verdict
    if verdict.verdict == "stop":
        return Status("safety", Level.ERROR, text, {"verdict": verdict.verdict})
    slow = verdict.verdict == "slow" or verdict.warnings
    return Status("safety", Level.WARN if slow else Level.OK, text, {"verdict": verdict.verdict})


def of_battery(battery: Battery, limits: Thresholds) -> Status:
    """Return the status of the battery, by the thresholds of the body's file."""
    text = f"{battery.percentage:.0f} %, {battery.voltage:.1f} V"
    low = battery.percentage <= limits.battery_warn
    empty = battery.percentage <= limits.battery_stop
    level = Level.ERROR if empty else Level.WARN if low else Level.OK
    return Status("battery", level, text, {"percentage": f"{battery.percentage:.1f}"})


def array(make: Make, stamp_ns: int, robot: str, found: Iterable[Status]) -> Any:
    """Return diagnostic_msgs/DiagnosticArray; `robot` is the hardware's id."""
    return make(
        "diagnostic_msgs/msg/DiagnosticArray",
        header=header(make, stamp_ns, ""),
        status=[_status(make, robot, one) for one in found],
    )


def _status(make: Make, robot: str, one: Status) -> Any:
    values = [
        make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
        for key, value in one.values.items()
    ]
    return make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=int(one.level),
        name=f"gigabrain: {one.name}",
        message=one.text,
        hardware_id=robot,
        values=values,
    )


def _of_causes(
    name: str, causes: Iterable[Cause], values: Mapping[str, object], fine: str
) -> Status:
    held = tuple(causes)
    if not held:
        return Status(name, Level.OK, fine, values)
    level = Level.ERROR if any(cause.latching for cause in held) else Level.WARN
    return Status(name, level, _in_words(held), values)


def _in_words(causes: Iterable[Cause]) -> str:
    return "; ".join(f"{one.text} ({one.remedy})" if one.remedy else one.text for one in causes)
