"""The ports of emulators: they appear, disappear, slow down, and belong to one emulator."""

import asyncio
import os
import select
import socket
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest

from gigabrain_drivers.bodies.ros2 import emulator as ros2_emulator
from gigabrain_drivers.bodies.ros2.emulator import RosPort
from gigabrain_drivers.bodies.ros2.options import Address, CommandTopic, Ros2Options, Topics
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.emulator import Emulator, claimed
from gigabrain_drivers.emulators.ports import Pty
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.testing.processes import free_endpoint
from gigabrain_zenoh.testing.waiting import until


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


async def test_a_host_that_reconnects_finds_the_same_port(tmp_path: Path) -> None:
    pty, received = Pty(tmp_path / "port"), list[bytes]()
    pty.on_bytes = received.append
    pty.plug()
    for word in (b"one", b"two"):
        fd = opened(pty.path)
        os.write(fd, word)
        await until(lambda word=word: word in received)
        os.close(fd)
    pty.unplug()


async def test_bytes_are_raw_both_ways(tmp_path: Path) -> None:
    pty, received, every = Pty(tmp_path / "port"), list[bytes](), bytes(range(256))
    pty.on_bytes = received.append
    pty.plug()
    fd = opened(pty.path)
    os.write(fd, every)
    await until(lambda: b"".join(received) == every)
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


async def test_bytes_on_the_wire_are_lost_when_it_is_unplugged(tmp_path: Path) -> None:
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


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="needs /proc")
def test_the_port_of_a_killed_emulator_cannot_be_opened(tmp_path: Path) -> None:
    port = tmp_path / "base"
    program = (
        "import asyncio, os, pathlib, signal, sys\n"
        "from gigabrain_drivers.emulators.ports import Pty\n"
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
        for _ in range(50):  # until another pty has the name
            opened.extend(os.openpty())
            if os.ttyname(opened[-1]) == name:
                break
        assert port.is_symlink()
        assert not port.exists()
    finally:
        for descriptor in opened:
            os.close(descriptor)


async def test_unplugging_leaves_a_port_that_another_emulator_has_replaced(tmp_path: Path) -> None:
    first, second = Pty(tmp_path / "base"), Pty(tmp_path / "base")
    first.plug()
    second.plug()  # as if the folder was cleared and claimed again
    mine = os.readlink(tmp_path / "base")
    first.unplug()
    assert os.readlink(tmp_path / "base") == mine
    second.unplug()
    assert not (tmp_path / "base").is_symlink()


async def test_an_ordinary_file_is_not_replaced_by_a_port(tmp_path: Path) -> None:
    (tmp_path / "base").write_text("somebody's")
    run = Run(folder=Path(), link="emulated", emulator=str(tmp_path))
    with pytest.raises(ConfigError, match=r"cannot create ports in .*base exists"):
        async with Emulator("mycustombot", run):
            pass
    assert (tmp_path / "base").read_text() == "somebody's"


def test_a_folder_of_ports_can_be_used_by_one_emulator_only(tmp_path: Path) -> None:
    folder = tmp_path / "ports"
    with claimed(folder), pytest.raises(ConfigError, match="another emulator"), claimed(folder):
        pass
    with claimed(folder):
        pass
    (tmp_path / "file").touch()
    with (
        pytest.raises(ConfigError, match="file: that name is taken; choose another folder"),
        claimed(tmp_path / "file"),
    ):
        pass


async def test_emulated_nodes_whose_port_is_taken_use_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = CommandTopic(type="geometry_msgs/msg/Twist")
    options = Ros2Options(
        driver="ros2",
        transport="rmw_zenoh",
        port=str(tmp_path / "base"),
        topics=Topics(command=command),
        watchdog="none",
    )
    port = RosPort(tmp_path / "base", options)
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        addresses = iter([Address(router=taken), Address(router=free_endpoint())])
        monkeypatch.setattr(ros2_emulator, "_free_address", lambda _: next(addresses))
        port.plug()
        await until(port.path.exists, "the nodes")
        assert taken not in port.path.read_text()
        port.unplug()
        await until(lambda: not port.path.exists(), "the end of the nodes")
