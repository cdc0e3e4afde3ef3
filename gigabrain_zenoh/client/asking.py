"""What is asked of a robot, and what becomes of the answer."""

from typing import TypeVar

from gigabrain_schemas.audit import AuditRecord, AuditRequest
from gigabrain_schemas.base import Message
from gigabrain_schemas.requests import GateReply
from gigabrain_schemas.topics import AUDIT_LOG, Service
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.errors import BodyLost, Refused
from gigabrain_zenoh.runtime.audit import in_order
from gigabrain_zenoh.security.identity_files import may_not_ask

Q = TypeVar("Q", bound=Message)

ANSWER_S = 1.0  # how long a robot may take to answer


async def ask(bus: Bus, service: Service[Q, GateReply], request: Q, keys: str = "") -> GateReply:
    """The gate's answer. Raises BodyLost where there is none, also for want of rights of `keys`."""
    replies = await bus.ask(service, request, timeout_s=ANSWER_S)
    if not replies:
        doubt = may_not_ask(keys) or "; is it running?"
        raise BodyLost(f"no driver answers {service.key}{doubt}")
    return replies[0]


def granted(reply: GateReply) -> GateReply:
    """A reply that grants what was asked. Raises Refused, with the gate's reason."""
    if not reply.ok:
        raise Refused(f"{reply.robot_type}: {reply.text}")
    return reply


async def audit_log(bus: Bus, newest: int) -> tuple[AuditRecord, ...]:
    """The newest entries of all processes that keep a log. Raises BodyLost where none does."""
    pages = await bus.ask(AUDIT_LOG, AuditRequest(newest=newest), timeout_s=ANSWER_S)
    if not pages:
        raise BodyLost("nobody here keeps an audit log; is the driver running?")
    return in_order([page.records for page in pages])[-newest:]
