"""What a process went by, in its own order, put together from a recording."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence

from msgspec import Struct

from gigabrain_schemas.heard import WAITED, Heard
from gigabrain_schemas.tasks import Granted
from gigabrain_schemas.topics import GRANTED, HEARD
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.recording.gaps import header_of
from gigabrain_zenoh.recording.reading import Sample
from gigabrain_zenoh.runtime.replay import Event

_heard = Codec(HEARD.type, HEARD.max_bytes)
_granted = Codec(GRANTED.type, GRANTED.max_bytes)


class Hearing(Struct, frozen=True, kw_only=True):
    """One life of a process, as far as it was recorded."""

    events: list[Event]
    began_ns: int  # Unix time of the first of them, by the process's own clock
    until_ns: int  # when the process last said what it went by
    lost: int  # messages that it looked at, and the recording does not hold


def hearing(samples: Sequence[Sample], process: str) -> Hearing | None:
    """The last life of `process`; None where it did not say what it went by."""
    key = HEARD.at(process)
    told = _last_life(_heard.decode(one.payload) for one in samples if one.key == key)
    if not told:
        return None
    held = _by_number(samples, process)
    events: list[Event] = []
    lost = 0
    for at_ns, name, seq in _entries(told):
        payload = bytes((seq > 0,)) if name == WAITED else _nearest(held.get((name, seq)), at_ns)
        if payload is None:
            lost += 1
        else:
            events.append(_event(at_ns - told[0].began_ns, name, payload))
    return Hearing(events=events, began_ns=told[0].began_ns, until_ns=told[-1].stamp_ns, lost=lost)


def _last_life(all_of_them: Iterable[Heard]) -> list[Heard]:
    told: list[Heard] = []
    for one in all_of_them:
        if told and one.seq <= told[-1].seq:  # it has started anew
            told = []
        told.append(one)
    return told


def _entries(told: Iterable[Heard]) -> Iterator[tuple[int, str, int]]:
    """Unix time [ns], which never goes back, key and number of each."""
    newest_ns = 0
    for word in told:
        for one in word.taken:
            newest_ns = max(newest_ns, word.began_ns + one.after_us * 1000)
            yield newest_ns, word.keys[one.key], one.seq


def _by_number(
    samples: Iterable[Sample], process: str
) -> dict[tuple[str, int], list[tuple[int, bytes]]]:
    """Time and payload of each message, but for what others were asked, by key and number."""
    held: dict[tuple[str, int], list[tuple[int, bytes]]] = defaultdict(list)
    for sample in samples:
        header = header_of(sample.payload)
        if sample.key != GRANTED.key or header.process in ("", process):
            held[sample.key, header.seq].append((sample.log_ns, sample.payload))
    return held


def _nearest(alike: Sequence[tuple[int, bytes]] | None, at_ns: int) -> bytes | None:
    """Of messages with one number, as of a sender that has started anew, the nearest in time."""
    if not alike:
        return None
    return min(alike, key=lambda one: abs(one[0] - at_ns))[1]


def _event(at_ns: int, key: str, payload: bytes) -> Event:
    if key != GRANTED.key:
        return at_ns, key, payload
    granted: Granted = _granted.decode(payload)
    return at_ns, granted.service, granted.request.encode()
