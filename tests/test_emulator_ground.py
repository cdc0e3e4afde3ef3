"""What emulators stand on: ptys that can be unplugged, faults, stations, and their process."""

import asyncio
import os
import select
import subprocess
import sys
import termios
import time
from pathlib import Path

import msgspec
import pytest

from gigabrain_drivers.emulators import DEVICES
from gigabrain_drivers.emulators.base import Device
from gigabrain_drivers.emulators.claim import claimed
from gigabrain_drivers.emulators.emulator import Emulator, device_class
from gigabrain_drivers.emulators.faults import Faults, FaultyWire
from gigabrain_drivers.emulators.pty import Pty
from gigabrain_drivers.emulators.station import Station
from gigabrain_drivers.robot import Run
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import ConfigError, UnknownName
from tests.line_rig import until


class Collector:
    """A wire, or a port, that remembers what was written."""

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
    """Says back what it hears, and `.` each step."""

    period_s = 0.005

    def feed(self, data: bytes) -> None:
        self.wire.write(data)

    def step(self, now_ns: int) -> None:
        self.wire.write(b".")

    def reset(self) -> None:
        self.wire.write(b"ready")


def opened(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)


async def test_a_port_appears_disappears_and_comes_back_empty(tmp_path: Path) -> None:
    pty = Pty(tmp_path / "deeper" / "port")
    assert not pty.write(b"nobody")
    pty.plug()
    pty.plug()
    fd = opened(pty.path)
    pty.write(b"old")
    pty.unplug()
    pty.unplug()
    assert not pty.path.is_symlink()
    with pytest.raises(OSError, match=r".*"):
        os.write(fd, b"x")
    os.close(fd)
    pty.plug()
    fd = opened(pty.path)
    with pytest.raises(BlockingIOError):
        os.read(fd, 10)
    os.close(fd)
    pty.unplug()


async def test_a_host_that_goes_and_comes_back_finds_the_same_port(tmp_path: Path) -> None:
    pty, heard = Pty(tmp_path / "port"), list[bytes]()
    pty.on_bytes = heard.append
    pty.plug()
    for word in (b"one", b"two"):
        fd = opened(pty.path)
        os.write(fd, word)
        await until(lambda word=word: word in heard)
        os.close(fd)
    pty.unplug()


async def test_bytes_are_raw_both_ways(tmp_path: Path) -> None:
    pty, heard, every = Pty(tmp_path / "port"), list[bytes](), bytes(range(256))
    pty.on_bytes = heard.append
    pty.plug()
    fd = opened(pty.path)
    os.write(fd, every)
    await until(lambda: b"".join(heard) == every)
    pty.write(every)
    assert select.select([fd], [], [], 60.0)[0]
    assert os.read(fd, 1000) == every
    os.close(fd)
    pty.unplug()


async def test_a_slow_line_takes_ten_bits_a_byte(tmp_path: Path) -> None:
    pty = Pty(tmp_path / "port", baud=9600)
    pty.plug()
    fd = opened(pty.path)
    began = time.monotonic()
    pty.write(b"x" * 96)  # 100 ms
    termios.tcgetattr(fd)
    with pytest.raises(BlockingIOError):
        os.read(fd, 200)
    await until(lambda: select.select([fd], [], [], 0)[0])
    assert time.monotonic() - began >= 0.09
    os.close(fd)
    pty.unplug()


async def test_what_is_on_the_wire_when_it_is_unplugged_is_gone(tmp_path: Path) -> None:
    pty = Pty(tmp_path / "port", baud=9600)
    pty.plug()
    pty.write(b"x" * 48)
    pty.unplug()
    pty.plug()
    fd = opened(pty.path)
    await asyncio.sleep(0.1)
    with pytest.raises(BlockingIOError):
        os.read(fd, 100)
    os.close(fd)
    pty.unplug()


def test_faults_do_to_the_bytes_what_they_say() -> None:
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


def test_bytes_pile_up_while_a_line_hangs() -> None:
    wire = FaultyWire(Collector())
    wire.faults = Faults(frozen=True)
    assert wire.incoming(b"a") == wire.incoming(b"b") == b""
    wire.faults = Faults()
    assert wire.incoming(b"c") == b"abc"


def test_of_a_thousand_bytes_about_so_many_have_one_flipped_bit() -> None:
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


def test_faults_are_strict() -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(b'{"silense": true}', type=Faults)
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(b'{"bit_errors": 1.5}', type=Faults)


@pytest.mark.parametrize("driver", sorted(DEVICES))
def test_every_device_of_the_table_is_a_device(driver: str) -> None:
    assert issubclass(device_class(driver), Device)


def test_a_driver_without_a_device_says_which_have_one() -> None:
    with pytest.raises(UnknownName, match="no emulator for driver 'lime'; did you mean 'line'"):
        device_class("lime")


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="needs /proc")
def test_the_port_of_an_emulator_that_was_killed_leads_nowhere(tmp_path: Path) -> None:
    port = tmp_path / "base"
    program = (
        "import asyncio, os, pathlib, signal, sys\n"
        "from gigabrain_drivers.emulators.pty import Pty\n"
        "async def main():\n"
        "    Pty(pathlib.Path(sys.argv[1])).plug()\n"
        "    print(os.path.realpath(sys.argv[1]))\n"
        "    sys.stdout.flush()\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
        "asyncio.run(main())\n"
    )
    ran = subprocess.run(
        (sys.executable, "-c", program, str(port)), stdout=subprocess.PIPE, text=True, check=False
    )
    assert ran.stdout.startswith("/dev/")
    name, opened = ran.stdout.strip(), list[int]()
    try:
        for _ in range(50):  # until the name is somebody else's
            opened.extend(os.openpty())
            if os.ttyname(opened[-1]) == name:
                break
        assert port.is_symlink()
        assert not port.exists()
    finally:
        for descriptor in opened:
            os.close(descriptor)


async def test_a_port_that_is_another_emulators_by_now_is_left(tmp_path: Path) -> None:
    first, second = Pty(tmp_path / "base"), Pty(tmp_path / "base")
    first.plug()
    second.plug()  # as after a folder was cleared and claimed anew
    mine = os.readlink(tmp_path / "base")
    first.unplug()
    assert os.readlink(tmp_path / "base") == mine
    second.unplug()
    assert not (tmp_path / "base").is_symlink()


async def test_a_file_that_is_no_port_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "base").write_text("somebody's")
    run = Run(folder=Path(), link="emulated", emulator=str(tmp_path))
    with pytest.raises(ConfigError, match=r"no ports can be made in .*base is there"):
        async with Emulator("mycustombot", run):
            pass
    assert (tmp_path / "base").read_text() == "somebody's"


def test_a_folder_of_ports_is_one_emulators_at_a_time(tmp_path: Path) -> None:
    folder = tmp_path / "ports"
    with claimed(folder), pytest.raises(ConfigError, match="another emulator"), claimed(folder):
        pass
    with claimed(folder):
        pass
    (tmp_path / "file").touch()
    with (
        pytest.raises(ConfigError, match="file: File exists; expected a folder"),
        claimed(tmp_path / "file"),
    ):
        pass


async def test_gigabrain_emulate_is_a_body_until_it_is_told_to_end(tmp_path: Path) -> None:
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
            process.terminate()  # not only Ctrl-C takes the ports away
            assert await process.wait() == 0
        assert not (tmp_path / "scan").is_symlink()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
