"""The emulator's process: with a driver under a supervisor, or alone."""

import asyncio
import logging
from collections.abc import Callable, Coroutine
from pathlib import Path

import msgspec

from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.driver.world_requests import serve_world
from gigabrain_drivers.emulators.base import Snapshot
from gigabrain_drivers.emulators.emulator import Emulator
from gigabrain_drivers.emulators.faults import Faults
from gigabrain_drivers.emulators.hand import posture_in
from gigabrain_drivers.sim.live_world import LiveWorld, News
from gigabrain_schemas.topics import SIM_SCENE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.restoring import RestoringPublisher
from gigabrain_zenoh.config.settings import EmulatorConfig
from gigabrain_zenoh.errors import BodyLost, ConfigError, unknown
from gigabrain_zenoh.host.signals import stop_signals
from gigabrain_zenoh.host.terminal import typed_lines
from gigabrain_zenoh.runtime.heartbeat import Progress

log = logging.getLogger(__name__)

POLL_S = 0.05  # period of checking the file with the faults
MOVE = "move"  # command before positions of joints
FAULTS_FILE = "faults.json"  # {STATION: {FAULT: VALUE}}, in the folder of the ports


async def run(config: EmulatorConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Run the emulator until the process ends; the truth is in its description."""
    async with make_emulator(config) as emulator:
        bus.report = emulator.report
        physics = emulator.body.simulation
        bus.progress = Progress(lambda: (bus.clock.now_ns(),), lambda: physics.time_ns)
        serve_world(bus, show_world(emulator, config.world, bus).change)
        ready()
        await watch(emulator, Path(config.folder) / FAULTS_FILE)


def show_world(emulator: Emulator, name: str, bus: Bus) -> LiveWorld:
    """Publish the emulated world for viewers, after each step of the physics thread."""
    world, loop = (
        LiveWorld(emulator.body.simulation, name, emulator.body.robot.cameras),
        asyncio.get_running_loop(),
    )

    restoring = RestoringPublisher(bus)

    def publish(news: News) -> None:
        for topic, message in news:
            (restoring if topic is SIM_SCENE else bus).publish(topic, message)
        restoring.restore()

    def step(_: Snapshot) -> None:
        if news := world.step():
            loop.call_soon_threadsafe(publish, news)

    emulator.body.on_step.append(step)
    return world


async def emulate(config: EmulatorConfig, say: Callable[[str], None]) -> None:
    """Run the emulator until a stop signal; read faults from standard input, line by line."""
    with stop_signals() as stop:
        async with make_emulator(config) as emulator:
            await _until(stop, _serve_terminal(emulator, config, say))


async def _serve_terminal(
    emulator: Emulator, config: EmulatorConfig, say: Callable[[str], None]
) -> None:
    """Apply typed faults until cancelled. Raises BodyLost if the physics ends."""
    for name, port in emulator.ports.items():
        say(f"{config.body} in {config.world}: {name} at {where(port)}")
    say(f"faults, one line each: [{'|'.join(emulator.stations)}] "
        f"{' '.join(Faults.__struct_fields__)}; off ends them")  # fmt: skip
    if joints := emulator.body.robot.joints:
        say(f"a hand on limp joints: {MOVE} {joints[0].name}=20 ...; {MOVE} off takes it away")
    with typed_lines(lambda line: _apply_line(emulator, line, say)):
        await watch(emulator, Path(config.folder) / FAULTS_FILE)


async def _until(stop: asyncio.Event, work: Coroutine[None, None, None]) -> None:
    """Work until it raises, or until `stop` is set."""
    working, stopping = asyncio.ensure_future(work), asyncio.ensure_future(stop.wait())
    try:
        await asyncio.wait((working, stopping), return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            await working
    finally:
        for task in (working, stopping):
            task.cancel()
        await asyncio.gather(working, stopping, return_exceptions=True)


def where(port: str) -> str:
    """Return the address to connect to: the port itself, or the content of its file."""
    path = Path(port)
    return path.read_text(encoding="ascii").strip() if path.is_file() else port


def make_emulator(config: EmulatorConfig) -> Emulator:
    """Return the emulated robot of the settings. Raises ConfigError."""
    return Emulator(
        config.body,
        Run(
            folder=Path(),
            link="emulated",
            world=config.world,
            seed=config.seed,
            emulator=config.folder,
            cameras=config.cameras,
            checkpoint=config.checkpoint,
            changes=config.robot,
        ),
    )


async def watch(emulator: Emulator, path: Path) -> None:
    """Apply the faults in the file whenever it changes. Raises BodyLost if the physics ends."""
    seen = None
    while not emulator.body.lost:
        stamp = _changed_ns(path)
        if stamp != seen:
            seen = stamp
            _apply_file(emulator, path)
        await asyncio.sleep(POLL_S)
    raise BodyLost(emulator.body.lost)


def _changed_ns(path: Path) -> int | None:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return None


def _apply_file(emulator: Emulator, path: Path) -> None:
    try:
        faults = msgspec.json.decode(path.read_bytes(), type=dict[str, Faults])
        for name in faults:
            if name not in emulator.stations:
                raise unknown("station", name, emulator.stations)
    except FileNotFoundError:
        faults = {}
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError, ConfigError) as error:
        log.warning("%s: %s", path.name, error)
        return
    emulator.set(faults)
    log.info("faults: %s", faults or "none")


def _apply_line(emulator: Emulator, line: str, say: Callable[[str], None]) -> None:
    move, *words = line.split()
    try:
        if move == MOVE:
            body = emulator.body
            body.hand.move(posture_in(words, body.robot.joints))
            return
        emulator.set(emulator.parse_faults(line))
    except ConfigError as error:
        say(str(error))
    say(f"faults now: {emulator.describe_faults()}")
