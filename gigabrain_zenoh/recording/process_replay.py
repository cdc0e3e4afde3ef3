"""Feeds recorded input to a node in fake time, and compares its output with the recording.

These are not compared: the time of sending (`stamp_ns`), the message number (`seq`), sentences for
people (but their codes and values are), and safety's warnings about its computer. Numbers may
differ by FLOAT_TOLERANCE. Of several messages on one key for one tick and basis only the last is
compared, as their number depends on the order of two inputs within a tick.
"""

import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from gigabrain_schemas.base import Message
from gigabrain_schemas.body import Body
from gigabrain_schemas.logs import FINISHED, WAITED, AcceptedRequest, InputLog
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import (
    BODY,
    CMD_VEL,
    INPUT_LOG,
    INTENT,
    JOINT_CMD,
    MAP,
    POSE,
    REQUEST_LOG,
    SAFETY,
    STATE,
    WORLD,
    Topic,
    command_topic,
    current_key,
)
from gigabrain_zenoh.bus.headers import header_of
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.config.renames import renamed_settings
from gigabrain_zenoh.config.settings import Endpoint, ProcessConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.host.escaping import printable
from gigabrain_zenoh.recording.bag_reader import Bag, Sample, samples
from gigabrain_zenoh.recording.message_tables import message_of, row
from gigabrain_zenoh.runtime.replay import Event, Node, replay
from gigabrain_zenoh.safety import health

OUTPUTS: dict[str, tuple[Topic[Any], ...]] = {
    "perception": (WORLD, POSE, MAP),
    "decision": (INTENT,),
    "control": (CMD_VEL, JOINT_CMD),
    "safety": (SAFETY,),
}
NOT_COMPARED = ("stamp_ns", "seq")
SENTENCE = re.compile(r"(.*\.)?(text|remedy|reason)")  # fields with sentences for people
# relative, and absolute in the field's unit: kernels are compiled for the processor that runs them,
# and processors differ in the last digits
FLOAT_TOLERANCE = 1e-6
MAX_SHOWN_FIELDS = 10  # of an output that differs
PROCESSES_WITH_SETTINGS = ("perception", "decision")
# A process that is busy for a tick skips a state, but a replay does not.
MAX_UNMATCHED_SHARE = 0.1  # of outputs that only the recording or only the replay contains

NodeOf = Callable[[ProcessConfig], Node]
OutputId = tuple[str, int, int, int]  # key, boot, tick, basis

_input_log = Codec(INPUT_LOG.type, INPUT_LOG.max_bytes)
_granted = Codec(REQUEST_LOG.type, REQUEST_LOG.max_bytes)


class Difference(Struct, frozen=True, kw_only=True):
    """The first output that differs from the recording."""

    key: str
    tick: int
    basis: int
    fields: Mapping[str, tuple[object, object]]  # dotted name: recorded and replayed value


class ReplayResult(Struct, frozen=True, kw_only=True):
    """Result of a replay."""

    compared: int  # outputs
    only_recorded: int  # outputs
    only_replayed: int
    difference: Difference | None
    begun_late: bool = False  # the process sent messages before the recording began
    real_time: bool = False  # not in lock-step, and without a log of the order of inputs
    lost: int = 0  # inputs of the process that are not in the recording

    @property
    def same(self) -> bool:
        """Return whether the process behaves as recorded."""
        max_unmatched = MAX_UNMATCHED_SHARE * (self.compared + self.only_recorded)
        unmatched = max(self.only_recorded, self.only_replayed)
        return self.difference is None and unmatched <= max_unmatched


class RecordedInputs(Struct, frozen=True, kw_only=True):
    """Inputs of a process since its last start, in its own order, as far as they were recorded."""

    events: list[Event]
    start_ns: int  # Unix time of the process's first log of inputs
    end_ns: int  # Unix time of its last one
    lost: int  # inputs that are not in the recording


class RecordedRun(Struct, frozen=True, kw_only=True):
    """Inputs and outputs of a process in a recording."""

    inputs: list[Event]
    outputs: dict[OutputId, Message]
    exact: bool  # the process logged its inputs and their order
    lost: int = 0  # inputs that are not in the recording
    begun_late: bool  # the process sent messages before the recording began


def _outputs_of(path: Path, process: str) -> tuple[Topic[Any], ...]:
    """Return the output topics of a process; the recorded body may have its own command topic."""
    bodies = (message_of(sample) for sample in Bag(path) if sample.key == BODY.key)
    body = next((body for body in bodies if isinstance(body, Body)), None)
    return tuple(
        command_topic(body.description) if body and topic is CMD_VEL else topic
        for topic in OUTPUTS[process]
    )


def load_run(path: Path, process: str) -> RecordedRun:
    """Read the inputs of a process, with their times [ns], and its outputs. Raises ConfigError."""
    inputs: list[Sample] = []
    outputs: list[tuple[str, Message]] = []
    keys = {topic.key for topic in _outputs_of(path, process)}
    logs = {REQUEST_LOG.key, INPUT_LOG.at(process)}
    for sample in samples(path):
        message = message_of(sample) if sample.key in keys | logs else None
        if message is None and sample.key in logs:
            continue  # any client may have sent it
        if sample.key in keys and message and getattr(message, "source", BRAIN) == BRAIN:
            outputs.append((sample.key, message))
        else:
            inputs.append(sample)
    if not outputs:
        raise ConfigError(f"{path} holds no message from {process}")
    own = logged_inputs(inputs, process)
    if own:
        outputs = [each for each in outputs if own.start_ns <= each[1].stamp_ns <= own.end_ns]
        events = own.events
    else:
        first_ns = inputs[0].log_ns if inputs else 0
        events = with_requests([(s.log_ns - first_ns, s.key, s.payload) for s in inputs])
    if all(key in (WAITED, FINISHED) for _, key, _ in events):
        raise ConfigError(f"{path} holds no input of {process}; record all topics for a replay")
    return RecordedRun(
        inputs=events,
        outputs=_by_id(outputs),
        exact=own is not None,
        lost=own.lost if own else 0,
        begun_late=not outputs or outputs[0][1].seq > 1,
    )


def _by_id(outputs: Iterable[tuple[str, Message]]) -> dict[OutputId, Message]:
    return {(key, m.boot, m.tick, m.basis): _without_computer(m) for key, m in outputs}


def _without_computer(message: Message) -> Message:
    if not isinstance(message, SafetyState):
        return message
    warnings = tuple(each for each in message.warnings if each.code not in health.HOST_CODES)
    return msgspec.structs.replace(message, warnings=warnings)


def logged_inputs(recorded: Sequence[Sample], process: str) -> RecordedInputs | None:
    """Return the inputs of `process` since its last start; None if it did not log them."""
    key = INPUT_LOG.at(process)
    logs = _since_last_start(_input_log.decode(s.payload) for s in recorded if s.key == key)
    if not logs:
        return None
    by_number = _by_number(recorded, process)
    events: list[Event] = []
    lost = 0
    for at_ns, name, seq in _entries(logs):
        payload = (
            bytes((seq > 0,))
            if name in (WAITED, FINISHED)
            else _nearest(by_number[name, seq], at_ns)
        )
        if payload is None:
            lost += 1
        else:
            events.append(_as_request(at_ns - logs[0].began_ns, name, payload))
    return RecordedInputs(
        events=events, start_ns=logs[0].began_ns, end_ns=logs[-1].stamp_ns, lost=lost
    )


def _since_last_start(logs: Iterable[InputLog]) -> list[InputLog]:
    found: list[InputLog] = []
    for each in logs:
        if found and each.seq <= found[-1].seq:  # the process restarted
            found = []
        found.append(each)
    return found


def _entries(logs: Iterable[InputLog]) -> Iterator[tuple[int, str, int]]:
    """Yield Unix time [ns], which never decreases, key and number of each input."""
    newest_ns = 0
    for log in logs:
        for entry in log.taken:
            newest_ns = max(newest_ns, log.began_ns + entry.after_us * 1000)
            yield newest_ns, current_key(log.keys[entry.key]), entry.seq


def _by_number(
    recorded: Iterable[Sample], process: str
) -> dict[tuple[str, int], list[tuple[int, bytes]]]:
    """Return times and payloads by key and number, without the requests of other processes."""
    found: dict[tuple[str, int], list[tuple[int, bytes]]] = defaultdict(list)
    for sample in recorded:
        header = header_of(sample.payload)
        if sample.key != REQUEST_LOG.key or header.process in ("", process):
            found[sample.key, header.seq].append((sample.log_ns, sample.payload))
    return found


def _nearest(same_number: Sequence[tuple[int, bytes]], at_ns: int) -> bytes | None:
    """Return the payload nearest in time, as a restarted sender reuses its numbers."""
    nearest = min(same_number, key=lambda message: abs(message[0] - at_ns), default=None)
    return nearest[1] if nearest else None


def _as_request(at_ns: int, key: str, payload: bytes) -> Event:
    if key != REQUEST_LOG.key:
        return at_ns, key, payload
    granted: AcceptedRequest = _granted.decode(payload)
    return at_ns, granted.service, granted.request.encode()


def with_requests(inputs: Sequence[Event]) -> list[Event]:
    """Replace records of accepted requests by the requests, each where it took effect.

    This is before the first message that the process received after it; the recorded order may
    differ. For recordings in which the process did not log its inputs.
    """
    order = [((i, 1), event) for i, event in enumerate(inputs)]
    for i, (_, key, payload) in enumerate(inputs):
        if key != REQUEST_LOG.key:
            continue
        granted = _granted.decode(payload)
        later = (j for j, event in enumerate(inputs) if _is_after(granted, event, default=j > i))
        place = next(later, len(inputs) - 1)
        order[i] = ((place, 0), _as_request(inputs[place][0], key, payload))
    return [event for _, event in sorted(order, key=lambda one: one[0])]


def _is_after(granted: AcceptedRequest, event: Event, *, default: bool) -> bool:
    """Return whether a request was accepted before `event` was received."""
    _, key, payload = event
    if key not in (STATE.key, WORLD.key):
        return False
    header = header_of(payload)
    if header.boot != granted.boot:
        return default
    return header.tick > granted.tick if key == STATE.key else header.basis > granted.basis


def compare(
    recorded: Mapping[OutputId, Message], replayed: Mapping[OutputId, Message]
) -> ReplayResult:
    """Compare outputs in the recorded order."""
    both = [each for each in recorded if each in replayed]
    differences = (_difference(each[0], recorded[each], replayed[each]) for each in both)
    return ReplayResult(
        compared=len(both),
        only_recorded=len(recorded) - len(both),
        only_replayed=len(replayed.keys() - recorded.keys()),
        difference=next((each for each in differences if each), None),
    )


def _difference(key: str, recorded: Message, replayed: Message) -> Difference | None:
    before, after = row(recorded), row(replayed)
    fields = {
        field: (before.get(field), after.get(field))
        for field in dict.fromkeys((*before, *after))
        if not (field in NOT_COMPARED or SENTENCE.fullmatch(field))
        and not _same(before.get(field), after.get(field))
    }
    if not fields:
        return None
    return Difference(key=key, tick=recorded.tick, basis=recorded.basis, fields=fields)


def _same(recorded: object, replayed: object) -> bool:
    """Return whether two values are equal, numbers within FLOAT_TOLERANCE."""
    if isinstance(recorded, float) and isinstance(replayed, float):
        tolerance = FLOAT_TOLERANCE
        return math.isclose(recorded, replayed, rel_tol=tolerance, abs_tol=tolerance)
    return recorded == replayed


async def replay_process(
    path: Path, process: str, settings: dict[str, Any], node_of: NodeOf
) -> ReplayResult:
    """Replay a recording to a process. Raises ConfigError, and the errors of the process."""
    run = load_run(path, process)
    node = node_of(ProcessConfig(name=process, endpoint=Endpoint(), settings=settings))
    decoders = {
        topic.key: Codec(topic.type, topic.max_bytes).decode for topic in _outputs_of(path, process)
    }
    sent = await replay(node, run.inputs, process)
    replayed = _by_id((key, decoders[key](data)) for key, data in sent if key in decoders)
    real_time = not run.exact and read_notes(path).get("speed", "1") == "1"
    return msgspec.structs.replace(
        compare(run.outputs, replayed),
        real_time=real_time,
        lost=run.lost,
        begun_late=run.begun_late,
    )


def read_notes(path: Path) -> Mapping[str, str]:
    """Return the notes at the head of a recording."""
    bag = Bag(path)
    for _ in bag:
        break
    return bag.notes.get("gigabrain", {})


def settings_for(path: Path, process: str, settings: dict[str, Any] | None) -> dict[str, Any]:
    """Return the settings of a process for a replay: `settings`, or those of the recording.

    Raises ConfigError if neither contains the settings that the process needs.
    """
    if settings is None:
        notes = read_notes(path)
        if process in PROCESSES_WITH_SETTINGS and process not in notes:
            raise ConfigError(
                f"{path} does not hold the settings of {process}: it was recorded by "
                "`gigabrain record`; name the robot's deployment file: --deployment FILE"
            )
        settings = dict(msgspec.json.decode(notes.get(process, "{}")))
    return _without_side_effects(renamed_settings(settings, process), process)


def _without_side_effects(settings: dict[str, Any], process: str) -> dict[str, Any]:
    """Return settings with which a replay runs no programs and saves nothing."""
    if process in PROCESSES_WITH_SETTINGS:
        settings = settings | {"state_dir": ""}
    behaviour = settings.get("settings", {})
    if "scripts" in behaviour:
        settings["settings"] = behaviour | {"scripts": ""}
    return settings


async def replay_file(
    path: Path, process: str, settings: dict[str, Any] | None, node_of: NodeOf
) -> int:
    """Replay and print the result; return 0 if the process behaves as recorded, else 1.

    Without `settings` the process gets those of the recording.
    """
    result = await replay_process(path, process, settings_for(path, process, settings), node_of)
    for line in report_lines(path, process, result):
        print(printable(line))
    return 0 if result.same else 1


def report_lines(path: Path, process: str, result: ReplayResult) -> Iterator[str]:
    """Format the result of a replay for people."""
    counts = f"{result.compared} messages compared"
    if result.only_recorded or result.only_replayed:
        counts += f", {result.only_recorded} only in the recording, "
        counts += f"{result.only_replayed} only in the replay"
    if found := result.difference:
        yield f"{path}: {process} behaves differently; first difference:"
        yield f"{found.key} at tick {found.tick}, based on tick {found.basis}:"
        for field, (recorded, replayed) in islice(found.fields.items(), MAX_SHOWN_FIELDS):
            yield f"  {field}: recorded {recorded!r}, now {replayed!r}"
        if len(found.fields) > MAX_SHOWN_FIELDS:
            yield f"  and {len(found.fields) - MAX_SHOWN_FIELDS} other fields"
    elif not result.same:
        yield f"{path}: {process} sends at different times: {counts}"
    else:
        yield f"{path}: {process} behaves as recorded: {counts}"
    if result.same:
        return
    if result.real_time:
        yield "recorded in real time: messages within a tick may be in another order"
    if result.lost:
        yield f"{result.lost} messages that {process} received are not in the recording"
    if result.begun_late:
        yield "the recording begins in the middle of a run; its earlier part may be the reason"
