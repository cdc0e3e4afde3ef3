"""Inputs and requests that a process used, so that a recording of it can be replayed."""

from typing import Annotated

from msgspec import Meta, Struct

from gigabrain_schemas.base import Count, Key, Message, Name
from gigabrain_schemas.tasks import MAX_REQUEST_BYTES

MAX_ENTRIES = 4096  # entries in one message


class ConsumedInput(Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """One message that a process has used, or one piece of background work."""

    key: Count  # which of the keys
    seq: Count  # the message's own; of work: 1 where it was done in time, 0 where it was not
    after_us: Count  # [µs] after `began_ns`


class InputLog(Message, frozen=True, kw_only=True):
    """All inputs that a process has used since its last InputLog, in its own order.

    A busy process skips messages, and those on different keys arrive in any order; only the process
    knows what its output rests on. The key WAITED stands for background work.
    """

    began_ns: Count  # Unix time of the first entry, by the process's own clock
    keys: Annotated[tuple[Key, ...], Meta(max_length=MAX_ENTRIES)]
    taken: Annotated[tuple[ConsumedInput, ...], Meta(max_length=MAX_ENTRIES)]

    def __post_init__(self) -> None:
        if any(one.key >= len(self.keys) for one in self.taken):
            raise ValueError(f"an entry is of a key that is not among the {len(self.keys)} here")


WAITED = "~waited"


class AcceptedRequest(Message, frozen=True, kw_only=True):
    """A request that a process accepted, published at the moment from which it counts.

    It is an input like any message: `tick` and `basis` are the newest that the process had used.
    """

    process: Name = ""  # that accepted it
    service: Name  # key of the service, such as robot/goal
    request: Annotated[str, Meta(max_length=MAX_REQUEST_BYTES)]  # JSON, with its source
