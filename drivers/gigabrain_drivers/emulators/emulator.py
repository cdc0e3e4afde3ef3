"""An emulated robot: one body in MuJoCo, and for each link a device on its port."""

import asyncio
import contextlib
import dataclasses
import functools
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, Self, cast

import msgspec
from msgspec.structs import replace

from gigabrain_drivers import shipped_emulators
from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import LinkOptions, Run
from gigabrain_drivers.emulators.base import Broken, Device, EmulatedBody, Port, Wire
from gigabrain_drivers.emulators.faults import NO_FAULTS, Faults, FaultyWire, faults_in
from gigabrain_drivers.emulators.ports import Pty, TcpPort
from gigabrain_drivers.sim.body import MujocoOptions, SimBattery, sim_body
from gigabrain_drivers.sim.checkpoint import checkpoint_files
from gigabrain_drivers.sim.physics import resumed
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.loading import located
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import cannot_write
from gigabrain_zenoh.host.posix import fcntl
from gigabrain_zenoh.plugins import load_plugin

BASE, SCAN = "base", "scan"


def emulated_body(name: str, run: Run) -> EmulatedBody:
    """Return the robot called `name` in MuJoCo, from the `sim` part of its file.

    Its battery has the voltages of its real link. It continues from the run's checkpoints, if
    there are any. Raises ConfigError.
    """
    robot, _, options, folder = catalog.load_link(name, replace(run, link="sim"))
    if not isinstance(options, MujocoOptions):
        raise ConfigError(
            f"{robot.robot_type} has no MuJoCo model, so it cannot be emulated: "
            "use its own simulation (--link sim), or give it `sim: {driver: mujoco}` and a model"
        )
    run = replace(run, folder=folder)
    body, world = sim_body(robot, options, run), load_world(run.world, run.seed)
    _, _, real, _ = catalog.load_link(name, replace(run, link="emulated"))
    if volts := real.battery_volts():
        body = dataclasses.replace(body, battery=_charged(body.battery, *volts))
    files = checkpoint_files(run)
    try:
        return EmulatedBody(robot, resumed(body, world, run.seed, files), run, files)
    except ConfigError as error:  # in the model that the file names
        raise located(catalog.robot_path(name), error) from None


def _charged(battery: SimBattery, empty: float, full: float) -> SimBattery:
    """Return the battery with the voltages [V] that the real link's driver expects."""
    nominal = (empty + full) / 2
    return dataclasses.replace(
        battery, empty_voltage=empty, nominal_voltage=nominal, full_voltage=full
    )


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Lock the folder for this process, until it ends or dies. Raises ConfigError."""
    with contextlib.ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            stack.callback(os.close, descriptor)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(
                f"another emulator uses {folder}; end it, or take another folder (--ports)"
            ) from None
        except OSError as error:
            raise cannot_write(folder, error, "choose another folder (--ports)") from None
        yield


def ports_error(folder: Path, error: OSError) -> ConfigError:
    """Return the error for ports that cannot be created."""
    return ConfigError(f"cannot create ports in {folder}: {error.strerror}; expected a folder")


class Station:
    """Plugs in a device and runs it. `device` is for reading; `set` changes its faults."""

    def __init__(self, make: Callable[[Wire], Device], port: Port, clock: Clock) -> None:
        self._port, self._clock = port, clock
        self._wire = FaultyWire(port)
        self.device = make(self._wire)
        self.faults = NO_FAULTS
        self._task: asyncio.Task[None] | None = None
        port.on_bytes = self._received

    def start(self) -> None:
        """Switch it on."""
        self._port.plug()
        self.device.reset()
        self._task = asyncio.create_task(self._run())

    async def close(self) -> None:
        """Switch it off and remove the port. May be called several times."""
        task, self._task = self._task, None
        if task:
            task.cancel()
            await asyncio.wait((task,))
        self._port.unplug()

    def set(self, faults: Faults) -> None:
        """Replace all faults."""
        before, self.faults, self._wire.faults = self.faults, faults, faults
        self.device.sag_volts = faults.brown_out
        self.device.silent_servo = faults.silent_servo
        self.device.halted = faults.frozen or faults.unplugged
        if faults.unplugged:
            self._port.unplug()
        else:
            self._port.plug()
        if before.reboot != faults.reboot:  # enter or leave reset, with the motors off
            self.device.reset()
        if before.frozen and not faults.frozen:
            self._received(b"")

    def _received(self, data: bytes) -> None:
        if data := self._wire.incoming(data):
            self.device.feed(data)

    async def _run(self) -> None:
        async for now_ns in self._clock.every(round(self.device.period_s * 1e9)):
            if not self.faults.reboot:
                self.device.step(now_ns)


class Emulator:
    """The emulated robot called `name`. Its ports exist inside its `async with` block.

    `run` names the world, the seed, and the folder of its ports.
    """

    def __init__(self, name: str, run: Run) -> None:
        _, _, options, _ = catalog.load_link(name, msgspec.structs.replace(run, link="emulated"))
        self.body: EmulatedBody = emulated_body(name, run)
        self.ports, self._folder = _ports(options), run.emulator
        self._claim = contextlib.ExitStack()
        clock = Clock()
        self.stations: dict[str, Station] = {}
        for station, its in _parts(options).items():
            device = device_class(its.driver)
            make = functools.partial(device, self.body, its)
            self.stations[station] = Station(make, device.port(its), clock)

    async def __aenter__(self) -> Self:
        folder = Path(self._folder)
        if self._folder:
            self._claim.enter_context(claimed(folder))
        try:
            for station in self.stations.values():
                station.start()
        except OSError as error:
            await self._end()
            raise ports_error(folder, error) from None
        self.body.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._end()

    async def _end(self) -> None:
        for station in self.stations.values():
            await station.close()
        await self.body.close()
        self._claim.close()

    def set(self, faults: Mapping[str, Faults]) -> None:
        """Replace all faults, by station."""
        for name, station in self.stations.items():
            wanted = faults.get(name, NO_FAULTS)
            if wanted != station.faults:
                station.set(wanted)
        body = faults.get(BASE, NO_FAULTS)
        self.body.set_broken(Broken(body.runaway, body.stuck_wheel, body.frozen_values))

    def report(self) -> Mapping[str, float | int | str | None]:
        """The truth of the run so far, and delays by this machine."""
        return self.body.report()

    def describe_faults(self) -> str:
        """Return the present faults, in the words of `parse_faults`."""
        parts = [f"{name} {s.faults}" for name, s in self.stations.items() if s.faults != NO_FAULTS]
        return "; ".join(parts) or "none"

    def parse_faults(self, words: str) -> dict[str, Faults]:
        """Return the faults in `[STATION] FAULT[=VALUE] ...`; without a station, for all.

        An empty text or `off` means no fault. Raises ConfigError naming the known words.
        """
        named = words.split()
        wanted = list(self.stations)
        if named and named[0] in self.stations:
            wanted = [named.pop(0)]
        faults = faults_in(named, self.stations)
        now = {name: station.faults for name, station in self.stations.items()}
        return {**now, **dict.fromkeys(wanted, faults)}


def device_class(driver: str) -> type[Device]:
    """Return the device class for a driver or a scan source, ours or an installed package's.

    Packages name theirs in the entry points `gigabrain.emulators`. Raises UnknownName.
    """
    shipped = shipped_emulators()
    device = load_plugin("emulator for driver", driver, shipped, "gigabrain.emulators")
    return cast("type[Device]", device)


def wire_kind(name: str) -> Literal["serial", "tcp", ""]:
    """Return the kind of line to an emulated robot's base; empty if it is no line of bytes.

    Raises ConfigError, and UnknownName.
    """
    if "emulated" not in catalog.robot_links(catalog.load_robot(name)):
        return ""
    run = Run(folder=Path(), link="emulated")
    _, _, options, _ = catalog.load_link(name, run)
    port = device_class(options.driver).port(options)
    if isinstance(port, TcpPort):
        return "tcp"
    return "serial" if isinstance(port, Pty) else ""


def _parts(options: LinkOptions) -> dict[str, Any]:
    """Return each station's options."""
    return {BASE: options, **({SCAN: options.scan} if options.scan else {})}


def _ports(options: LinkOptions) -> dict[str, str]:
    """Return the path or address of each station."""
    return {name: str(getattr(its, "port", "")) for name, its in _parts(options).items()}
