"""Fuzz checks of small files that are read back, and of words that people type."""

import contextlib
import fcntl
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.driver.gatekeeper import LatchFile
from gigabrain_drivers.links import serial_link
from gigabrain_drivers.links.tcp_link import address
from gigabrain_schemas.base import Cause
from gigabrain_schemas.body import GateStatus
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.limits import limits_of
from gigabrain_zenoh.host.terminal import LineSplitter
from gigabrain_zenoh.qa.proxy.chaos import parse_command
from gigabrain_zenoh.runtime.child import as_record
from gigabrain_zenoh.runtime.running import folder, running
from tests.fuzz.harness import split

PLACE = tempfile.TemporaryDirectory()  # removed at exit


def latch(data: bytes) -> None:
    """Whatever the file holds: it is read, and the gate that begins with it can be announced."""
    place = Path(PLACE.name)
    (place / "latch.json").write_bytes(data)
    found = LatchFile(place).read()
    state = gate.GateState(boot=1, causes=found.causes, estop_generation=found.estop_generation)
    state, _ = gate.step(CONFIG, state, gate.Estop("somebody"))
    status = gate.status(state)
    assert msgspec.json.decode(msgspec.json.encode(status), type=GateStatus) == status
    assert LatchFile(place).read() == found


def note(data: bytes) -> None:
    """A note of a running robot that cannot be read is taken away."""
    os.environ["XDG_RUNTIME_DIR"] = PLACE.name
    folder().mkdir(exist_ok=True)
    with (folder() / "1.json").open("wb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # as a living supervisor does
        file.write(data)
        file.flush()
        for robot in running():
            assert robot.pid > 0


def record(data: bytes) -> None:
    """A line of a child's output becomes a log record that can be written as JSON."""
    lines = LineSplitter()
    for line in [*lines.feed(data), lines.end()]:
        made = as_record(line, "child")
        assert isinstance(made["event"], str)
        assert isinstance(made["level"], str)
        msgspec.json.encode(made)


def typed(data: bytes) -> None:
    """Assert that typed text is parsed, or refused with ConfigError or ValueError."""
    text = data.decode(errors="replace")
    for parse in PARSERS:
        with contextlib.suppress(ConfigError, ValueError):
            parse(text)


CONFIG = gate.GateConfig(limits=limits_of(load_robot("mock")))
PARSERS: tuple[Callable[[str], object], ...] = (parse_command, address, serial_link.usb_id)
CHECKS = {"latch": latch, "note": note, "record": record, "typed": typed}


def check(data: bytes) -> None:
    """By the kind that the first line names."""
    name, rest = split(data, list(CHECKS))
    CHECKS[name](rest)


def seeds() -> Iterator[bytes]:
    """One good input of each kind."""
    cause = msgspec.json.encode(Cause(code="estop", text="stopped by somebody", latching=True))
    yield b'latch\n{"causes":[%s],"estop_generation":3}' % cause
    yield b'note\n{"pid":1,"label":"x","endpoint":{"connect":["tcp/127.0.0.1:7447"]}}'
    yield b'record\n{"t":1,"level":"info","process":"a","event":"b","text":"c"}\nplain\n'
    yield b"typed\ndown delay_ms=50 loss=0.1"
    yield b"typed\n192.168.1.10:8080"
    yield b"typed\nusb:0483:5740:A1"
