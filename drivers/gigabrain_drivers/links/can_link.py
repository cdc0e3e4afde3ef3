"""CAN buses, through python-can: SocketCAN on a robot, UDP multicast for emulated bodies.

A link carries bytes, so each frame is a record of 16 bytes, as in Linux's `struct can_frame`. The
hardware checks frames, so a record of another form cannot be a received frame.
"""

import re
import struct
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import can
from can.interfaces.udp_multicast import UdpMulticastBus

from gigabrain_drivers.links.frames import Spelling
from gigabrain_drivers.links.link import Link, LinkProblem, describe_error
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.host.files import read_bounded

BITRATE = 1_000_000  # [bit/s]
QUIET_NS = 200_000_000  # the bus is opened again after this time without a frame
MAX_FRAMES = 256  # in one read
MAX_ID, MAX_BYTES = 0x7FF, 8  # of a classic CAN frame with a standard identifier
HOP_LIMIT = 0  # of multicast: frames do not leave this machine
ARPHRD_CAN = 280  # type of CAN interfaces in sysfs
IFF_UP = 1
SYS_NET = Path("/sys/class/net")
SYS_FILES = ("type", "flags")  # files of an interface in SYS_NET
MAX_ADDRESS_BYTES = 256  # in a file with an address
_RECORD = struct.Struct("<IB3x8s")
_INTERFACE = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,14}")
_ADDRESS = re.compile(r"udp (\d+\.\d+\.\d+\.\d+) (\d{1,5})")


class CanFrame(NamedTuple):
    """A classic data frame with a standard identifier."""

    id: int
    data: bytes

    def record(self) -> bytes:
        """Return the frame as a record of 16 bytes."""
        return _RECORD.pack(self.id, len(self.data), self.data)


def records(frames: Iterable[CanFrame]) -> bytes:
    """Return frames as consecutive records, which a link carries."""
    return b"".join(frame.record() for frame in frames)


class CanDecoder:
    """Finds the frames in the bytes of a link. `errors` counts invalid records."""

    def __init__(self) -> None:
        self.errors = 0

    def feed(self, data: bytes) -> list[CanFrame]:
        """Return the frames in whole records; drop a partial record, as an error."""
        size = len(data) - len(data) % _RECORD.size
        self.errors += size != len(data)
        frames = list[CanFrame]()
        for id_, length, payload in _RECORD.iter_unpack(data[:size]):
            if id_ > MAX_ID or length > MAX_BYTES:
                self.errors += 1
            else:
                frames.append(CanFrame(id_, payload[:length]))
        return frames


class CanSpelling(Spelling):
    """Describes one direction of a bus: identifier, bytes, and meaning of each frame."""

    def __init__(self, describe: Callable[[CanFrame], str]) -> None:
        super().__init__(CanDecoder().feed, describe)

    def spell(self, data: bytes) -> list[str]:
        """Return a line of text for each frame, in the format of `candump`."""
        return [
            f"{frame.id:03x}#{frame.data.hex()}  {self._describe(frame)}"
            for frame in CanDecoder().feed(data)
        ]


def check_can_port(port: str) -> None:
    """Raise ValueError, as `port: ...`, unless it is a CAN interface or a file."""
    if "/" not in port and not _INTERFACE.fullmatch(port):
        raise ValueError(f"port: expected a CAN interface such as can0, got {port!r}")


def describe_interface(name: str, folder: Path = SYS_NET) -> str:
    """Return why a CAN interface cannot be used, in one line; empty if it can."""
    entry = folder / name
    try:
        kind, flags = ((entry / file).read_text(encoding="ascii").strip() for file in SYS_FILES)
    except OSError:
        others = [path.parent.name for path in folder.glob("*/type") if _is_can(path)]
        has = f"; there is {', '.join(sorted(others))}" if others else ""
        return f"no CAN interface {name}{has}: is the adapter plugged in?"
    if int(kind) != ARPHRD_CAN:
        return f"{name} is no CAN interface; expected one such as can0"
    if not int(flags, 16) & IFF_UP:
        return f"{name} is down: sudo ip link set {name} up type can bitrate {BITRATE}"
    return ""


def _is_can(path: Path) -> bool:
    try:
        return int(path.read_text(encoding="ascii")) == ARPHRD_CAN
    except OSError:
        return False


def open_multicast(group: str, port: int) -> can.BusABC:
    """Open a CAN bus on this machine, by UDP multicast. Raises LinkProblem."""
    try:
        return UdpMulticastBus(group, port=port, hop_limit=HOP_LIMIT, fd=False)
    except (can.CanError, OSError) as error:
        raise LinkProblem(f"CAN by UDP {group} port {port}: {describe_can(error)}") from None


def describe_can(error: Exception) -> str:
    """Describe an error of python-can in one line."""
    cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
    text = getattr(cause, "strerror", None) or str(cause)
    return " ".join(text.split()) or type(error).__name__


class CanLink(Link):
    """A SocketCAN interface, or an emulator's bus whose address is in a file.

    Only frames with `ids` are received; on SocketCAN, the others cost nothing.
    """

    def __init__(
        self, port: str, clock: Clock, ids: Sequence[int] = (), *, quiet_ns: int | None = QUIET_NS
    ) -> None:
        super().__init__(clock)
        self._port, self.quiet_ns = port, quiet_ns
        self._filters: list[Any] = [{"can_id": id_, "can_mask": MAX_ID} for id_ in ids]
        self._bus: can.BusABC | None = None
        self.lost_frames = 0  # received frames that are not data frames, such as error frames

    def __str__(self) -> str:
        return self._port

    def write(self, data: bytes) -> bool:
        """Send all frames now; return whether all were sent. Never blocks or raises."""
        if self._fd is None or self._bus is None:
            return False
        try:
            for frame in CanDecoder().feed(data):
                self._bus.send(message_of(frame))
        except (can.CanError, OSError) as error:
            self.drop(describe_can(error))
            return False
        self._trace("tx", data)
        return True

    async def _connect(self) -> int:
        if "/" in self._port:
            self._bus = open_multicast(*read_address(Path(self._port)))
        else:
            self._bus = self._open_interface()
        return self._bus.fileno()

    def _open_interface(self) -> can.BusABC:
        if problem := describe_interface(self._port):
            raise LinkProblem(problem)
        try:
            return can.Bus(
                interface="socketcan", channel=self._port, can_filters=self._filters or None
            )
        except (can.CanError, OSError) as error:
            raise LinkProblem(f"{self._port}: {describe_can(error)}") from None

    def _shut(self) -> None:
        bus, self._bus = self._bus, None
        if bus:
            bus.shutdown()

    def _cut_short(self) -> None:
        """Do nothing: there are no partial frames."""

    def _read(self, fd: int) -> bool:
        """Read the waiting frames; return whether there were any."""
        if self._bus is None:
            return False
        try:
            frames, others = receive(self._bus)
        except OSError as error:
            self.drop(describe_error(error))
            return False
        self.lost_frames += others
        if not frames:
            return False
        self._received_ns = self._clock.now_ns()
        data = records(frames)
        self._trace("rx", data)
        self._call(self.on_bytes, data)
        return True


def receive(bus: can.BusABC) -> tuple[list[CanFrame], int]:
    """Return the waiting data frames of a bus, and the number of other frames.

    Raises OSError if the bus is gone.
    """
    frames, others = list[CanFrame](), 0
    for _ in range(MAX_FRAMES):
        try:
            message = bus.recv(0)
        except can.CanOperationError as error:
            if isinstance(error.__cause__, OSError):
                raise error.__cause__ from None
            others += 1
            continue
        if message is None:
            break
        if message.is_extended_id or message.is_remote_frame or message.is_error_frame:
            others += 1
        else:
            frames.append(CanFrame(message.arbitration_id, bytes(message.data)))
    return frames, others


def message_of(frame: CanFrame) -> can.Message:
    """Return a frame as a message of python-can."""
    return can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False)


def address_text(group: str, port: int) -> str:
    """Return the text of a file that names a bus on UDP multicast."""
    return f"udp {group} {port}\n"


def read_address(path: Path) -> tuple[str, int]:
    """Return (group, port) of the bus that a file names. Raises LinkProblem."""
    try:
        text = read_bounded(path, MAX_ADDRESS_BYTES).decode("ascii", "replace").strip()
    except OSError:
        raise LinkProblem(f"no file {path}: is the emulator running?") from None
    match = _ADDRESS.fullmatch(text)
    if not match:
        raise LinkProblem(f"{path}: expected `udp GROUP PORT`, as an emulator writes it")
    return match[1], int(match[2])
