"""The audit log: actions on the robot, their sources and results."""

from typing import Annotated, Literal

from msgspec import Meta

from gigabrain_schemas.base import Count, Message, Name, Text

MOST_RECORDS = 1000
What = Literal[
    "boot",  # the driver has started
    "end",  # the driver ends, and leaves the body in its safe state
    "estop",
    "release",
    "enable",
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

    newest: Annotated[int, Meta(ge=1, le=MOST_RECORDS)] = 100


class AuditPage(Message, frozen=True, kw_only=True):
    """The newest entries, oldest first."""

    records: Annotated[tuple[AuditRecord, ...], Meta(max_length=MOST_RECORDS)] = ()
