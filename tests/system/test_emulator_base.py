"""The common base of the emulators: unpluggable ptys, faults, stations, and their process."""

import asyncio
import os
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from gigabrain_drivers import shipped_emulators
from gigabrain_drivers.emulators.base import Device
from gigabrain_drivers.emulators.emulator import Station, device_class
from gigabrain_drivers.emulators.faults import Faults, FaultyWire
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import UnknownName
from gigabrain_zenoh.testing.waiting import until


class Collector:
    """A wire or port that records what was written."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.plugged = False
        self.on_bytes = lambda data: None

    def write(self, data: bytes) -> bool:
        self.pieces.append(data)
        return True

    def plug(self) -> None:
        self.plugged = True

    def unplug(self) -> None:
        self.plugged = False


class Echo(Device):
    """A device that echoes its input, and writes `.` at each step."""

    period_s = 0.005

    def feed(self, data: bytes) -> None:
        self.wire.write(data)

    def step(self, now_ns: int) -> None:
        self.wire.write(b".")

    def reset(self) -> None:
        self.wire.write(b"ready")


def test_each_fault_changes_the_bytes_as_named() -> None:
    out = Collector()
    wire = FaultyWire(out, seed=1)
    wire.faults = Faults(silence=True)
    assert wire.write(b"hello")
    assert wire.incoming(b"in") == b"in"
    wire.faults = Faults(deaf=True)
    wire.write(b"hello")
    assert wire.incoming(b"in") == b""
    assert out.pieces == [b"hello"]
    wire.faults = Faults(half_frames=1.0)
    wire.write(b"hello!")
    assert out.pieces[-1] == b"hel"
    wire.faults = Faults(garbage=1.0)
    wire.write(b"hello")
    assert out.pieces[-1].endswith(b"hello")
    assert len(out.pieces[-1]) > 5


def test_bytes_queue_up_while_a_line_is_frozen() -> None:
    wire = FaultyWire(Collector())
    wire.faults = Faults(frozen=True)
    assert wire.incoming(b"a") == wire.incoming(b"b") == b""
    wire.faults = Faults()
    assert wire.incoming(b"c") == b"abc"


def test_the_bit_error_rate_flips_one_bit_in_that_share_of_bytes() -> None:
    wire = FaultyWire(Collector(), seed=1)
    wire.faults = Faults(bit_errors=0.05)
    noisy = wire.incoming(bytes(10_000))
    assert 400 < sum(byte != 0 for byte in noisy) < 600
    assert all(byte.bit_count() <= 1 for byte in noisy)


async def test_a_station_runs_its_device_with_its_faults() -> None:
    port = Collector()
    station = Station(lambda wire: Echo(None, None, wire), port, Clock())
    station.start()
    await until(lambda: b"." in port.pieces)
    assert port.plugged
    assert port.pieces[0] == b"ready"
    port.on_bytes(b"hello")
    assert b"hello" in port.pieces
    station.set(Faults(reboot=True))
    port.pieces.clear()
    port.on_bytes(b"lost")
    await asyncio.sleep(0.02)
    assert port.pieces == []
    station.set(Faults(unplugged=True))
    assert not port.plugged
    station.set(Faults(frozen=True, brown_out=1.5))
    assert port.plugged
    port.pieces.clear()
    port.on_bytes(b"late")
    assert (port.pieces, station.device.sag_volts) == ([], 1.5)
    station.set(Faults())
    assert b"late" in port.pieces
    await station.close()
    await station.close()
    assert not port.plugged


def test_unknown_and_invalid_faults_are_refused() -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(b'{"silense": true}', type=Faults)
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(b'{"bit_errors": 1.5}', type=Faults)


@pytest.mark.parametrize("driver", sorted(shipped_emulators()))
def test_every_listed_emulator_is_a_device(driver: str) -> None:
    assert issubclass(device_class(driver), Device)


def test_a_driver_without_an_emulator_is_refused_with_a_suggestion() -> None:
    with pytest.raises(UnknownName, match="no emulator for driver 'lime'; did you mean 'line'"):
        device_class("lime")


async def test_gigabrain_emulate_serves_its_ports_until_it_is_terminated(tmp_path: Path) -> None:
    command = [
        sys.executable, "-c", "from gigabrain_zenoh.cli.app import main; main()",
        "emulate", "mycustombot", "--ports", str(tmp_path),
    ]  # fmt: skip
    paths = os.pathsep.join(sys.path)
    process = await asyncio.create_subprocess_exec(
        *command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": paths},
    )
    assert process.stdin
    assert process.stdout
    try:
        async with asyncio.timeout(120):
            assert (await process.stdout.readline()).endswith(b"/base\n")
            assert (await process.stdout.readline()).endswith(b"/scan\n")
            await process.stdout.readline()
            assert (tmp_path / "base").is_symlink()
            process.stdin.write(b"base unplugged\nnonsense\n")
            assert await process.stdout.readline() == b"faults now: base unplugged\n"
            assert b"no fault 'nonsense'" in await process.stdout.readline()
            assert await process.stdout.readline() == b"faults now: base unplugged\n"
            assert not (tmp_path / "base").is_symlink()
            process.terminate()  # SIGTERM also removes the ports
            assert await process.wait() == 0
        assert not (tmp_path / "scan").is_symlink()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
