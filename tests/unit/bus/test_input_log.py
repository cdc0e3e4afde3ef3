"""The input log of a process: published in order, and replayed in the same order."""

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future

from msgspec.structs import replace

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.examples import example
from gigabrain_schemas.logs import FINISHED, WAITED, AcceptedRequest, InputLog
from gigabrain_schemas.topics import BODY, GOAL, INPUT_LOG, REQUEST_LOG, SCAN, STATE
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.input_log import PublishedInputLogger, ReplayedInputLogger
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.host.threads import Job
from gigabrain_zenoh.recording.bag_reader import Sample
from gigabrain_zenoh.recording.process_replay import logged_inputs
from gigabrain_zenoh.runtime.replay import replay

MS = 1_000_000
AT = 1_700_000_000_000_000_000  # Unix time [ns]


class RecordedLog:
    """An input logger with a clock that the test moves, and its published messages."""

    def __init__(self) -> None:
        self.messages: list[InputLog] = []
        self.now_ns = AT
        self.input_log = PublishedInputLogger(self.messages.append, lambda: self.now_ns)

    def entries(self) -> list[tuple[str, int, int]]:
        return [
            (message.keys[entry.key], entry.seq, entry.after_us)
            for message in self.messages
            for entry in message.taken
        ]


def finished() -> Job:
    job: Job = Future()
    job.set_result(None)
    return job


def test_what_was_looked_at_is_said_in_order_with_its_time() -> None:
    recorded = RecordedLog()
    recorded.input_log.note("robot/state", 7)
    recorded.now_ns += 3 * MS
    recorded.input_log.note("robot/scan", 2)
    recorded.input_log.note("robot/state", 9)
    recorded.input_log.flush()
    assert recorded.messages[0].began_ns == AT
    assert recorded.entries() == [
        ("robot/state", 7, 0),
        ("robot/scan", 2, 3000),
        ("robot/state", 9, 3000),
    ]


def test_a_message_that_two_parts_of_a_node_look_at_is_one_but_those_without_number_are_many() -> (
    None
):
    recorded = RecordedLog()
    for seq in (4, 4, 5, 0, 0):
        recorded.input_log.note("robot/body", seq)
    recorded.input_log.flush()
    assert [seq for _, seq, _ in recorded.entries()] == [4, 5, 0, 0]


def test_it_is_said_after_half_a_second_or_2048_entries_and_when_the_clock_goes_back() -> None:
    recorded = RecordedLog()
    recorded.input_log.note("robot/state", 1)
    recorded.now_ns += 499 * MS
    recorded.input_log.note("robot/state", 2)
    assert not recorded.messages
    recorded.now_ns += 1 * MS
    recorded.input_log.note("robot/state", 3)
    assert [len(message.taken) for message in recorded.messages] == [2]
    recorded.now_ns -= 1 * MS
    recorded.input_log.note("robot/state", 4)
    assert [len(message.taken) for message in recorded.messages] == [2, 1]
    for seq in range(5, 2060):
        recorded.input_log.note("robot/state", seq)
    assert [len(message.taken) for message in recorded.messages] == [2, 1, 2048]


def test_nothing_is_said_of_nothing() -> None:
    recorded = RecordedLog()
    recorded.input_log.flush()
    assert not recorded.messages


def test_whether_work_beside_was_in_time_is_said_as_well() -> None:
    recorded = RecordedLog()
    assert not recorded.input_log.in_time(Future(), 0.0)
    assert recorded.input_log.in_time(finished(), 0.0)
    recorded.input_log.flush()
    assert [(key, seq) for key, seq, _ in recorded.entries()] == [(WAITED, 0), (WAITED, 1)]


async def test_work_that_counts_when_it_is_done_is_said_before_it_counts() -> None:
    recorded, counted = RecordedLog(), asyncio.Event()
    work: Job = Future()
    recorded.input_log.when_done(work, lambda job: (job.result(), counted.set()))
    recorded.input_log.note("robot/state", 7)
    threading.Thread(target=work.set_result, args=(None,)).start()
    await counted.wait()
    recorded.input_log.note("robot/state", 8)
    recorded.input_log.flush()
    entries = [(key, seq) for key, seq, _ in recorded.entries()]
    assert entries == [("robot/state", 7), (FINISHED, 1), ("robot/state", 8)]


def test_a_replay_counts_the_oldest_work_where_it_is_logged_and_waits_for_it() -> None:
    past, counted = ReplayedInputLogger(), list[int]()
    for number in (1, 2):
        past.when_done(finished(), lambda _, number=number: counted.append(number))
    assert counted == []
    past.finish()
    assert counted == [1]
    past.finish()
    past.finish()  # no work has begun
    assert counted == [1, 2]


def test_a_replay_takes_work_as_done_where_it_was_done_then() -> None:
    past = ReplayedInputLogger()
    past.outcomes.extend((False, True))
    assert not past.in_time(finished(), 0.0)  # as recorded
    assert past.in_time(finished(), 0.0)
    assert past.in_time(finished(), 0.0)  # no outcome is recorded


def state(seq: int) -> bytes:
    return codec.encode(replace(example(STATE.type), seq=seq))


def sample(at_ms: int, key: str, payload: bytes) -> Sample:
    return Sample(AT + at_ms * MS, key, "", "", payload)


def test_a_bus_with_a_journal_notes_what_is_valid() -> None:
    async def listen() -> list[tuple[str, int, int]]:
        recorded, network = RecordedLog(), LocalNetwork()
        bus = Bus(network.transport(), FakeClock())
        bus.input_log = recorded.input_log
        bus.latest(STATE)
        network.deliver(STATE.key, state(3))
        network.deliver(STATE.key, b"no message")
        recorded.input_log.flush()
        await bus.close()
        return recorded.entries()

    assert asyncio.run(listen()) == [("robot/state", 3, 0)]


def life(*entries: tuple[str, int], at_ms: int, seq: int, process: str = "decision") -> Sample:
    """Return the sample of an input log: these entries, a millisecond apart, from `at_ms` on."""
    recorded = RecordedLog()
    recorded.now_ns += at_ms * MS
    for key, number in entries:
        if key == WAITED:
            recorded.input_log.in_time(finished() if number else Future(), 0.0)
        else:
            recorded.input_log.note(key, number)
        recorded.now_ns += 1 * MS
    recorded.input_log.flush()
    message = replace(recorded.messages[0], seq=seq, stamp_ns=recorded.now_ns)
    return sample(at_ms + 10, INPUT_LOG.at(process), codec.encode(message))


def test_a_recording_is_put_into_the_order_of_the_process_without_what_it_passed_over() -> None:
    samples = [
        sample(0, STATE.key, state(1)),
        sample(20, STATE.key, state(2)),
        sample(40, STATE.key, state(3)),
        sample(41, SCAN.key, codec.encode(replace(example(SCAN.type), seq=1))),
        life((SCAN.key, 1), (STATE.key, 3), (WAITED, 0), (BODY.key, 8), at_ms=45, seq=1),
        life((STATE.key, 2), at_ms=45, seq=1, process="control"),
    ]
    own = logged_inputs(samples, "decision")
    assert own
    assert [(at, key) for at, key, _ in own.events] == [
        (0, "robot/scan"),
        (1 * MS, "robot/state"),
        (2 * MS, WAITED),
    ]
    assert own.events[1][2] == state(3)
    assert own.lost == 1  # a body that is not recorded
    assert own.start_ns == AT + 45 * MS
    assert own.end_ns == AT + 49 * MS
    assert logged_inputs(samples, "perception") is None


def test_of_a_process_that_started_anew_the_last_life_is_taken() -> None:
    samples = [
        sample(0, STATE.key, state(1)),
        sample(500, STATE.key, state(2)),
        life((STATE.key, 1), at_ms=1, seq=4),
        life((STATE.key, 2), at_ms=501, seq=1),
    ]
    own = logged_inputs(samples, "decision")
    assert own
    assert [payload for _, _, payload in own.events] == [state(2)]
    assert own.start_ns == AT + 501 * MS


def test_of_two_messages_of_one_number_the_nearer_in_time_is_meant() -> None:
    early = codec.encode(replace(example(STATE.type), seq=1, tick=5))
    late = codec.encode(replace(example(STATE.type), seq=1, tick=900))
    own = logged_inputs(
        [
            sample(0, STATE.key, early),
            sample(9000, STATE.key, late),
            life((STATE.key, 1), at_ms=9002, seq=1),
        ],
        "decision",
    )
    assert own
    assert own.events == [(0, "robot/state", late)]


def test_what_was_granted_is_asked_again_where_the_process_had_granted_it() -> None:
    request = '{"x":1.0,"y":2.0}'
    granted = codec.encode(AcceptedRequest(service=GOAL.key, request=request, seq=6))
    own = logged_inputs(
        [
            sample(0, STATE.key, state(1)),
            sample(1, REQUEST_LOG.key, granted),
            life((REQUEST_LOG.key, 6), (STATE.key, 1), at_ms=2, seq=1),
        ],
        "decision",
    )
    assert own
    assert own.events == [(0, "robot/goal", request.encode()), (1 * MS, "robot/state", state(1))]


async def test_a_replayed_node_finds_each_wait_as_it_ended_then() -> None:
    found: list[tuple[int, bool]] = []

    async def node(bus: Bus, ready: Callable[[], None]) -> None:
        def look(_key: str, one: RobotState) -> None:
            found.append((one.seq, bus.input_log.in_time(finished(), 0.0)))

        bus.subscribe(STATE, look)
        ready()
        await bus.failed

    await replay(
        node,
        [
            (0, STATE.key, state(1)),
            (0, WAITED, b"\0"),
            (1, STATE.key, state(2)),
            (1, WAITED, b"\1"),
            (2, STATE.key, state(3)),
        ],
    )
    assert found == [(1, False), (2, True), (3, True)]
