"""Where a request counted that was granted, where its process did not say so itself."""

from collections.abc import Sequence

from gigabrain_schemas.tasks import Granted
from gigabrain_schemas.topics import GRANTED, STATE, WORLD
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.recording.gaps import header_of
from gigabrain_zenoh.runtime.replay import Event

_granted = Codec(GRANTED.type, GRANTED.max_bytes)


def placed(heard: Sequence[Event]) -> list[Event]:
    """The same with what was granted as requests, each where it counted.

    That is before the first message which its process had not heard by then; on the wire both come
    by ways of their own.
    """
    order = [((i, 1), event) for i, event in enumerate(heard)]
    for i, (_, key, payload) in enumerate(heard):
        if key != GRANTED.key:
            continue
        granted = _granted.decode(payload)
        later = (j for j, event in enumerate(heard) if _after(granted, event, here=j > i))
        there = next(later, len(heard) - 1)
        at_ns, request = heard[there][0], granted.request.encode()
        order[i] = ((there, 0), (at_ns, granted.service, request))
    return [event for _, event in sorted(order, key=lambda one: one[0])]


def _after(granted: Granted, event: Event, *, here: bool) -> bool:
    """Whether `event`, recorded later or not, had not been heard when a request was granted."""
    _, key, payload = event
    if key not in (STATE.key, WORLD.key):
        return False
    header = header_of(payload)
    if header.boot != granted.boot:
        return here
    return header.tick > granted.tick if key == STATE.key else header.basis > granted.basis
