"""Process replay: recorded input through the real node in fake time, its output against the record.

What cannot be the same is left aside: when a message was sent (`stamp_ns`), its number (`seq`), and
what safety says of its computer. Several messages that a node sends on one key for one tick and
basis are one word, of which the last counts: which of two inputs within a tick was quicker decides
how often it is repeated.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from gigabrain_schemas.base import Message
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import (
    CMD_VEL,
    INTENT,
    JOINT_CMD,
    MAP,
    POSE,
    SAFETY,
    WORLD,
    Topic,
)
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.config.process_config import ProcessConfig
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.recording.fields import message_of, row
from gigabrain_zenoh.recording.heard import hearing
from gigabrain_zenoh.recording.placing import placed
from gigabrain_zenoh.recording.reading import Bag, Sample, samples
from gigabrain_zenoh.runtime.deployment import deployment_path, load_deployment
from gigabrain_zenoh.runtime.process import Node
from gigabrain_zenoh.runtime.replay import Event, replay
from gigabrain_zenoh.safety import host

SAYS: dict[str, tuple[Topic[Any], ...]] = {
    "perception": (WORLD, POSE, MAP),
    "decision": (INTENT,),
    "control": (CMD_VEL, JOINT_CMD),
    "safety": (SAFETY,),
}
ASIDE = ("stamp_ns", "seq")
WITH_SETTINGS = ("perception", "decision")
# a replay runs no programs, and remembers nothing
NOWHERE = {"perception": {"state_dir": ""}, "decision": {"scripts": "", "state_dir": ""}}

ELSEWHEN = 0.1  # share of words that may be said in one of the two alone
# A process that is busy for a tick passes over a state; a replay has all the time in the world.

NodeOf = Callable[[ProcessConfig], Node]
Word = tuple[str, int, int, int]  # key, boot, tick, basis


class Difference(Struct, frozen=True, kw_only=True):
    """The first place where a process says something else than it did."""

    key: str
    tick: int
    basis: int
    field: str  # dotted
    recorded: object
    now: object
    then_said: Message
    now_said: Message


class Outcome(Struct, frozen=True, kw_only=True):
    """What a replay came to."""

    words: int  # compared
    only_then: int  # recorded, and not said now
    only_now: int
    difference: Difference | None
    begun_late: bool = False  # the process had spoken before the recording began
    real_time: bool = False  # not in lock-step, and nobody has said in which order it heard
    lost: int = 0  # messages that it went by, and the recording does not hold

    @property
    def same(self) -> bool:
        """Whether the process still does what it did."""
        most = ELSEWHEN * (self.words + self.only_then)
        return self.difference is None and max(self.only_then, self.only_now) <= most


class Past(Struct, frozen=True, kw_only=True):
    """What a recording knows of a process."""

    heard: list[Event]
    said: dict[Word, Message]
    exact: bool  # the process itself has said what it heard, and in which order
    lost: int = 0  # of that, what the recording does not hold
    begun_late: bool  # it had spoken before


def load(path: Path, process: str) -> Past:
    """What the process heard, at which times [ns], and what it said. Raises ConfigError."""
    heard: list[Sample] = []
    said: list[tuple[str, Message]] = []
    keys = {topic.key for topic in SAYS[process]}
    for sample in samples(path):
        message = message_of(sample) if sample.key in keys else None
        if message and getattr(message, "source", BRAIN) == BRAIN:
            said.append((sample.key, message))
        else:
            heard.append(sample)
    if not said:
        raise ConfigError(f"{path} holds nothing that {process} has said")
    own = hearing(heard, process)
    if own:
        said = [one for one in said if own.began_ns <= one[1].stamp_ns <= own.until_ns]
        events = own.events
    else:
        events = placed([(e.log_ns - heard[0].log_ns, e.key, e.payload) for e in heard])
    return Past(
        heard=events,
        said=_words(said),
        exact=own is not None,
        lost=own.lost if own else 0,
        begun_late=not said or said[0][1].seq > 1,
    )


def _words(said: Iterable[tuple[str, Message]]) -> dict[Word, Message]:
    return {(key, m.boot, m.tick, m.basis): _without_computer(m) for key, m in said}


def _without_computer(message: Message) -> Message:
    if not isinstance(message, SafetyState):
        return message
    warnings = tuple(each for each in message.warnings if each.code not in host.CODES)
    return msgspec.structs.replace(message, warnings=warnings)


def compare(then: Mapping[Word, Message], now: Mapping[Word, Message]) -> Outcome:
    """Word by word, in the order in which they were said then."""
    both = [word for word in then if word in now]
    found = (_differs(word, then[word], now[word]) for word in both)
    return Outcome(
        words=len(both),
        only_then=len(then) - len(both),
        only_now=len(now.keys() - then.keys()),
        difference=next((each for each in found if each), None),
    )


def _differs(word: Word, then: Message, now: Message) -> Difference | None:
    before, after = row(then), row(now)
    for field in dict.fromkeys((*before, *after)):
        if field not in ASIDE and before.get(field) != after.get(field):
            return Difference(
                key=word[0],
                tick=then.tick,
                basis=then.basis,
                field=field,
                recorded=before.get(field),
                now=after.get(field),
                then_said=then,
                now_said=now,
            )
    return None


async def replay_process(
    path: Path, process: str, settings: dict[str, Any], node_of: NodeOf
) -> Outcome:
    """Feed a recording to a process as it is now. Raises ConfigError, and what ends the process."""
    past = load(path, process)
    node = node_of(ProcessConfig(name=process, endpoint=Endpoint(), settings=settings))
    kinds = {topic.key: Codec(topic.type, topic.max_bytes).decode for topic in SAYS[process]}
    sent = await replay(node, past.heard, process)
    now = _words((key, kinds[key](data)) for key, data in sent if key in kinds)
    unsure = not past.exact and notes(path).get("speed", "1") == "1"
    return msgspec.structs.replace(
        compare(past.said, now), real_time=unsure, lost=past.lost, begun_late=past.begun_late
    )


def notes(path: Path) -> Mapping[str, str]:
    """What a recording says of itself at its head."""
    bag = Bag(path)
    for _ in bag:
        break
    return bag.notes.get("gigabrain", {})


def settings_for(path: Path, process: str, deployment: str | None) -> dict[str, Any]:
    """The settings of a process: of a deployment file, or those that the recording holds.

    Raises ConfigError where the process has settings and neither tells them.
    """
    if deployment:
        loaded = load_deployment(deployment_path(deployment))
        told = {"perception": loaded.perception, "decision": loaded.decision}
        settings = dict(msgspec.to_builtins(told.get(process, {})))
    else:
        held = notes(path)
        if process in WITH_SETTINGS and process not in held:
            raise ConfigError(
                f"{path} does not hold the settings of {process}, as it was recorded from beside; "
                "name the robot's deployment file: --deployment FILE"
            )
        settings = dict(msgspec.json.decode(held.get(process, "{}")))
    return settings | NOWHERE.get(process, {})


async def replay_file(path: Path, process: str, deployment: str | None, node_of: NodeOf) -> int:
    """Replay and tell; 0 where the process does what it did, 1 where it does not."""
    outcome = await replay_process(path, process, settings_for(path, process, deployment), node_of)
    for line in in_words(path, process, outcome):
        print(line)
    return 0 if outcome.same else 1


def in_words(path: Path, process: str, outcome: Outcome) -> Iterator[str]:
    """What a replay came to, for people."""
    said = f"{outcome.words} messages compared"
    if outcome.only_then or outcome.only_now:
        said += f", {outcome.only_then} only in the recording, {outcome.only_now} only now"
    if found := outcome.difference:
        yield f"{path}: {process} does something else; the first difference:"
        yield f"{found.key} at tick {found.tick}, resting on tick {found.basis}: {found.field}"
        yield f"  recorded {found.recorded!r}, now {found.now!r}"
        yield f"  recorded {msgspec.json.encode(found.then_said).decode()}"
        yield f"  now      {msgspec.json.encode(found.now_said).decode()}"
    elif not outcome.same:
        yield f"{path}: {process} speaks at other times: {said}"
    else:
        yield f"{path}: {process} does what it did: {said}"
    if not outcome.same and outcome.real_time:
        yield "it was recorded in real time: two messages within a tick may have changed places"
    if outcome.lost and not outcome.same:
        yield f"{outcome.lost} messages that it went by are not in the recording"
    if not outcome.same and outcome.begun_late:
        yield "the recording begins in the middle of a run, whose earlier part may be the reason"
