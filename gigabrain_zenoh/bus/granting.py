"""What was asked of a process, and changes what it does, is said again for recordings."""

import msgspec

from gigabrain_schemas.base import Message
from gigabrain_schemas.tasks import Granted
from gigabrain_schemas.topics import GRANTED
from gigabrain_zenoh.bus.bus import Bus


def grant(bus: Bus, key: str, request: Message, basis: int) -> None:
    """Tell that from now on a request counts which was asked on `key`.

    `basis` is the tick of the newest world that was thought about.
    """
    text = msgspec.json.encode(request).decode()
    granted = Granted(process=bus.process, service=key, request=text)
    sent = bus.publish(GRANTED, granted, basis=basis)
    bus.journal.note(GRANTED.key, sent.seq)
