"""Logs of a robot: audit log, input logs of processes, and accepted requests."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

from gigabrain_schemas.base import Count, Key, Message, Name, Text
from gigabrain_schemas.tasks import MAX_REQUEST_BYTES

MAX_RECORDS = 1000
What = Literal[
    "boot",  # the driver starts
    "end",  # the driver ends, with the body in its safe state
    "estop",
    "release",
    "enable",
    "limp",  # torque of an arm's joints is switched off
    "hold",  # torque is switched on again
    "take",  # an enable took the body from another source
    "mode",  # the gate's mode changed
    "raised",  # a cause of safety, the driver or the gate began
    "cleared",  # a cause ended
    "refused",  # commands were not obeyed
    "stranger",  # the router refused a client
]


class AuditRecord(Message, frozen=True, kw_only=True):
    """An audit entry. Its wall time is `stamp_ns`, its robot time `boot` and `tick`."""

    process: Name  # writer of the entry
    what: What
    source: Name  # the person or process that acted
    ok: bool = True  # the request was accepted
    code: Name = ""  # of the cause, the mode or the refusal
    text: Text = ""  # a sentence for people
    times: Count = 1  # number of equal events that this entry stands for


class AuditRequest(Message, frozen=True, kw_only=True):
    """Ask for the newest entries. The request may be empty."""

    newest: Annotated[int, Meta(ge=1, le=MAX_RECORDS)] = 100


class AuditPage(Message, frozen=True, kw_only=True):
    """The newest entries, oldest first."""

    records: Annotated[tuple[AuditRecord, ...], Meta(max_length=MAX_RECORDS)] = ()


MAX_ENTRIES = 4096  # entries in one message


class ConsumedInput(Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """One message that a process used, or one piece of background work."""

    key: Count  # index in `keys`
    seq: Count  # `seq` of the message; of work: 1 if it was done in time, else 0
    after_us: Count  # [µs] after `began_ns`


class InputLog(Message, frozen=True, kw_only=True):
    """All inputs that a process used since its last InputLog, in the order of use.

    A busy process skips messages, and those on different keys arrive in any order. So only the
    process knows from which inputs it computed an output. The key WAITED stands for background work
    that is due, FINISHED for work that counts as soon as it is finished.
    """

    began_ns: Count  # Unix time of the first entry, by the process's clock
    keys: Annotated[tuple[Key, ...], Meta(max_length=MAX_ENTRIES)]
    taken: Annotated[tuple[ConsumedInput, ...], Meta(max_length=MAX_ENTRIES)]

    def __post_init__(self) -> None:
        if any(one.key >= len(self.keys) for one in self.taken):
            raise ValueError(f"an entry is of a key that is not among the {len(self.keys)} here")


WAITED = "~waited"
FINISHED = "~finished"


class AcceptedRequest(Message, frozen=True, kw_only=True):
    """A request that a process accepted, published when it takes effect.

    It is an input like any message: `tick` and `basis` are those of the newest inputs.
    """

    process: Name = ""  # process that accepted the request
    service: Name  # key of the service, such as robot/goal
    request: Annotated[str, Meta(max_length=MAX_REQUEST_BYTES)]  # JSON, with its source
