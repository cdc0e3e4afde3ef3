"""`gigabrain bench cameras`: CPU and memory of a robot's cameras, and latency of contours."""

import statistics
from collections import defaultdict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import Struct

from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import DEPTH, HEALTH, WORLD
from gigabrain_schemas.vision import DepthImage
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.qa.judging import table_of
from gigabrain_zenoh.qa.robot_under_test import (
    LOOPBACK,
    ProcessGroup,
    measured_robot,
    report_of,
)

if TYPE_CHECKING:
    from rich.table import Table

SETTLE_S = 3.0  # imports and first calls do not count
MB = 1e6
CAMERA = "camera"


class RobotCost(Struct, frozen=True, kw_only=True):
    """CPU and memory of the processes of one robot, by name."""

    cpu: Mapping[str, float]  # mean share of one core
    pss_bytes: Mapping[str, int]  # memory; shared pages are divided by the number of users


class CameraCost(Struct, frozen=True, kw_only=True):
    """Costs of a robot without and with cameras."""

    body: str
    world: str
    seconds: float
    without: RobotCost
    cameras: RobotCost
    rendering_cpu: float  # share of one core, within the process `camera`
    latency_ms: tuple[float, ...]  # from each exposure to a world with its contours

    @property
    def added_cpu(self) -> float:
        """CPU that cameras and vision add, without rendering, as a share of one core."""
        with_cameras, without = sum(self.cameras.cpu.values()), sum(self.without.cpu.values())
        return with_cameras - without - self.rendering_cpu

    @property
    def added_pss_bytes(self) -> int:
        """Memory that cameras and vision add [bytes]."""
        return sum(self.cameras.pss_bytes.values()) - sum(self.without.pss_bytes.values())


class Latencies:
    """Measures the time from each depth image to a world with its contours, by Unix time."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._exposed: dict[tuple[str, int], int] = {}
        self.ms: list[float] = []
        bus.subscribe(DEPTH, self._on_depth)
        bus.subscribe(WORLD, self._on_world)

    def _on_depth(self, key: str, picture: DepthImage) -> None:
        self._exposed[key.removeprefix(f"{DEPTH.key}/"), picture.basis] = picture.stamp_ns

    def _on_world(self, _key: str, world: WorldModel) -> None:
        for camera in world.cameras:
            stamp_ns = self._exposed.pop((camera.name, camera.exposure), None)
            if stamp_ns is not None:
                self.ms.append((self._bus.clock.unix_ns() - stamp_ns) / 1e6)


async def measure_cameras(
    body: str, world: str, seconds: float, show: Callable[[str], None]
) -> CameraCost:
    """Run a robot that avoids obstacles, first without and then with cameras.

    Raises ConfigError for a body without cameras, and GigabrainError when a process dies.
    """
    costs: list[RobotCost] = []
    rendered_s, latency_ms = 0.0, list[float]()
    for cameras in (False, True):
        show(f"{body} in {world}, {'with' if cameras else 'without'} cameras, for {seconds:g} s")
        deployment = Deployment(
            body=body, world=world, resume="auto", router=LOOPBACK, cameras=cameras
        )
        async with measured_robot(deployment) as (group, bus):
            if cameras and CAMERA not in group.pids:
                raise ConfigError(f"--body {body}: it has no cameras")
            await group.run_for(SETTLE_S)
            latencies = Latencies(bus) if cameras else None
            before_s = await _rendered_s(bus)
            costs.append(await _cost(group, bus, seconds))
            rendered_s = await _rendered_s(bus) - before_s
            latency_ms = latencies.ms if latencies else []
    return CameraCost(
        body=body,
        world=world,
        seconds=seconds,
        without=costs[0],
        cameras=costs[1],
        rendering_cpu=rendered_s / seconds,
        latency_ms=tuple(round(one, 2) for one in latency_ms),
    )


async def _rendered_s(bus: Bus) -> float:
    """Return the CPU time of rendering so far [s]."""
    return float(str((await report_of(bus, CAMERA)).get("render_cpu_s") or 0.0))


async def _cost(group: ProcessGroup, bus: Bus, seconds: float) -> RobotCost:
    shares: defaultdict[str, list[float]] = defaultdict(list)
    close = bus.subscribe(HEALTH, lambda _, health: _add_cpu(shares, health))
    await group.run_for(seconds)
    close()
    return RobotCost(
        cpu={name: statistics.fmean(cpu) for name, cpu in shares.items()},
        pss_bytes={name: pss_of(pid) for name, pid in group.pids.items()},
    )


def _add_cpu(shares: defaultdict[str, list[float]], health: Health) -> None:
    shares[health.process].append(health.cpu)


def pss_of(pid: int) -> int:
    """Return the proportional set size of a process [bytes]. Linux only."""
    rollup = Path(f"/proc/{pid}/smaps_rollup").read_text()
    line = next(line for line in rollup.splitlines() if line.startswith("Pss:"))
    return 1024 * int(line.split()[1])


def cameras_table(result: CameraCost) -> "Table":
    """Return the table that `gigabrain bench cameras` prints."""
    table = table_of("", "CPU without", "CPU with", "PSS without", "PSS with")
    for name in result.cameras.pss_bytes:
        table.add_row(
            name,
            *(f"{one.cpu[name]:.1%}" if name in one.cpu else "" for one in _both(result)),
            *(_mb(one.pss_bytes.get(name, 0)) for one in _both(result)),
        )
    table.add_row(
        "together",
        *(f"{sum(one.cpu.values()):.1%}" for one in _both(result)),
        *(_mb(sum(one.pss_bytes.values())) for one in _both(result)),
    )
    table.add_row("rendering, within camera", "", f"{result.rendering_cpu:.1%}", "", "")
    table.add_row(
        "added beside rendering", "", f"{result.added_cpu:.1%}", "", _mb(result.added_pss_bytes)
    )
    p50, p99 = (percentile(sorted(result.latency_ms), share) or 0.0 for share in (0.5, 0.99))
    table.add_row("exposure to robot/world [ms]", "", f"p50 {p50:.1f}", "", f"p99 {p99:.1f}")
    return table


def _both(result: CameraCost) -> tuple[RobotCost, RobotCost]:
    return result.without, result.cameras


def _mb(size: int) -> str:
    return f"{size / MB:.0f} MB" if size else ""
