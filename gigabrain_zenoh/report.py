"""What a demo run came to."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from gigabrain_zenoh.errors import ConfigError

MOTION_M = 0.05  # less than this is no motion


class Latency(Struct, frozen=True, kw_only=True):
    """From a scan's departure at the driver to the command that rests on it [ms]."""

    p50: float | None
    p99: float | None


class Report(Struct, frozen=True, kw_only=True):
    """One run. Contacts, clearance and distance are MuJoCo's truth, not the robot's own view."""

    body: str
    world: str
    seed: int
    sim_seconds: float
    distance_m: float
    contacts: int
    min_clearance_m: float
    turns: int
    restarts: int
    rejected_messages: int
    stale_commands_executed: int
    scan_to_cmd_ms: Latency
    speed: float
    lockstep_timeouts: int
    decisions: tuple[tuple[float, str], ...]  # simulated time [s] and the decision in words
    verdict: str  # "ok", or why not

    @property
    def ok(self) -> bool:
        """Whether the robot moved, touched nothing and lost no process."""
        return self.verdict == "ok"


def make_report(
    truth: Mapping[str, Any],
    decisions: Sequence[tuple[float, str]],
    *,
    speed: float,
    deaths: int,
    restarts: int,
    rejected: int,
) -> Report:
    """Put together what the driver says of the truth and what the supervisor saw."""
    distance, contacts = float(truth["distance_m"]), int(truth["contacts"])
    faults = []
    if contacts:
        faults.append(f"{contacts} contact{'s' if contacts > 1 else ''}")
    if distance < MOTION_M:
        faults.append("no motion")
    if deaths:
        faults.append(f"{deaths} process{'es' if deaths > 1 else ''} died")
    return Report(
        body=truth["body"],
        world=truth["world"],
        seed=truth["seed"],
        sim_seconds=truth["sim_seconds"],
        distance_m=distance,
        contacts=contacts,
        min_clearance_m=truth["min_clearance_m"],
        turns=sum(words.startswith("turning") for _, words in decisions),
        restarts=restarts,
        rejected_messages=rejected,
        stale_commands_executed=truth["stale_commands_executed"],
        scan_to_cmd_ms=Latency(p50=truth["scan_to_cmd_p50_ms"], p99=truth["scan_to_cmd_p99_ms"]),
        speed=speed,
        lockstep_timeouts=truth["lockstep_timeouts"],
        decisions=tuple(decisions),
        verdict=", ".join(faults) or "ok",
    )


def write_report(report: Report, path: Path) -> None:
    """As JSON. Raises ConfigError where that cannot be written."""
    try:
        path.write_bytes(msgspec.json.format(msgspec.json.encode(report)) + b"\n")
    except OSError as error:
        raise ConfigError(f"cannot write the report {path}: {error.strerror}") from None


def summary(report: Report) -> str:
    """One line for people."""
    p50, p99 = report.scan_to_cmd_ms.p50 or 0.0, report.scan_to_cmd_ms.p99 or 0.0
    return (
        f"{report.verdict}: {report.distance_m:.2f} m in {report.sim_seconds:.0f} s, "
        f"{report.turns} turns, {report.contacts} contacts, "
        f"closest {report.min_clearance_m:.2f} m, "
        f"scan to command {p50:.1f} ms (p99 {p99:.1f} ms)"
    )
