"""Logs of a robot: who acted on it, and what each process has consumed for its outputs."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

from gigabrain_schemas.base import Count, Key, Message, Name, Text
from gigabrain_schemas.tasks import MAX_REQUEST_BYTES

MAX_RECORDS = 1000
What = Literal[
    "boot",  # the driver has started
    "end",  # the driver ends, and leaves the body in its safe state
    "estop",
    "release",
    "enable",
    "limp",  # an arm's joints are let go of
    "hold",  # and held again
    "take",  # an enable that took the body from another source
    "mode",  # the gate's mode has changed
    "raised",  # a cause, by safety, the driver or the gate
    "cleared",
    "refused",  # commands that were not obeyed
    "stranger",  # a client that was refused at the router
]


class AuditRecord(Message, frozen=True, kw_only=True):
    """One entry. Its wall time is `stamp_ns`, the robot's time is `boot` and `tick`."""

    process: Name  # that wrote it down
    what: What
    source: Name  # who did it, or asked for it
    ok: bool = True  # whether it was granted
    code: Name = ""  # of the cause, the mode or the refusal
    text: Text = ""  # a sentence for people
    times: Count = 1  # how often it has happened, where the same happens again and again


class AuditRequest(Message, frozen=True, kw_only=True):
    """Asks for the newest entries. An empty request will do."""

    newest: Annotated[int, Meta(ge=1, le=MAX_RECORDS)] = 100


class AuditPage(Message, frozen=True, kw_only=True):
    """The newest entries, oldest first."""

    records: Annotated[tuple[AuditRecord, ...], Meta(max_length=MAX_RECORDS)] = ()


MAX_ENTRIES = 4096  # entries in one message


class ConsumedInput(Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """One message that a process has used, or one piece of background work."""

    key: Count  # which of the keys
    seq: Count  # the message's own; of work: 1 where it was done in time, 0 where it was not
    after_us: Count  # [µs] after `began_ns`


class InputLog(Message, frozen=True, kw_only=True):
    """All inputs that a process has used since its last InputLog, in its own order.

    A busy process skips messages, and those on different keys arrive in any order; only the process
    knows what its output rests on. The key WAITED stands for background work that is due,
    FINISHED for such work that counts as soon as it is finished.
    """

    began_ns: Count  # Unix time of the first entry, by the process's own clock
    keys: Annotated[tuple[Key, ...], Meta(max_length=MAX_ENTRIES)]
    taken: Annotated[tuple[ConsumedInput, ...], Meta(max_length=MAX_ENTRIES)]

    def __post_init__(self) -> None:
        if any(one.key >= len(self.keys) for one in self.taken):
            raise ValueError(f"an entry is of a key that is not among the {len(self.keys)} here")


WAITED = "~waited"
FINISHED = "~finished"


class AcceptedRequest(Message, frozen=True, kw_only=True):
    """A request that a process accepted, published at the moment from which it counts.

    It is an input like any message: `tick` and `basis` are the newest that the process had used.
    """

    process: Name = ""  # that accepted it
    service: Name  # key of the service, such as robot/goal
    request: Annotated[str, Meta(max_length=MAX_REQUEST_BYTES)]  # JSON, with its source
