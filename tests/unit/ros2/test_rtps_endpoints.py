"""Reliable writers and readers deliver over a network that loses and reorders messages."""

import random

import pytest

from gigabrain_zenoh.ros2.rtps_reader import (
    MAX_ALL_EARLY,
    MAX_ASSEMBLIES,
    MAX_EARLY,
    MAX_SAMPLE_BYTES,
    ReliableReader,
)
from gigabrain_zenoh.ros2.rtps_wire import (
    AckNack,
    Data,
    DataFragments,
    Gap,
    Heartbeat,
    NackFragments,
    Sample,
)
from gigabrain_zenoh.ros2.rtps_writer import HISTORY_S, MAX_HISTORY, ReliableWriter

WRITER, READER = b"\0\0\1\3", b"\0\0\2\4"
SERVER, CLIENT, OTHER = b"S" * 12, b"C" * 12, b"D" * 12
AT = ("127.0.0.1", 7411)


class Network:
    """One writer at SERVER, readers at other prefixes, and the submessages in transit."""

    def __init__(self, *, loss: float = 0.0, seed: int = 1, transient_local: bool = False):
        self.random, self.loss, self.now = random.Random(seed), loss, 0.0
        self.in_transit: list[tuple[bytes, bytes, object]] = []  # from, to, submessage
        self.sent = 0
        self.writer = ReliableWriter(WRITER, self.sender(SERVER), transient_local=transient_local)
        self.delivered: dict[bytes, list[bytes]] = {}
        self.readers: dict[bytes, ReliableReader] = {}

    def sender(self, source: bytes):
        def send(to, address, submessages):
            assert address == AT
            self.sent += 1
            if self.random.random() >= self.loss:
                self.in_transit.extend((source, to, each) for each in submessages)

        return send

    def join(self, prefix: bytes) -> ReliableReader:
        delivered = self.delivered[prefix] = []
        reader = ReliableReader(
            READER, self.sender(prefix), lambda _, data: delivered.append(data.payload)
        )
        self.readers[prefix] = reader
        reader.match(SERVER + WRITER, AT, self.now)
        self.writer.match(prefix + READER, AT, self.now)
        return reader

    def run(self, seconds: float, *, shuffled: bool = False) -> None:
        """Deliver submessages, and advance time in steps of 20 ms."""
        for _ in range(round(seconds / 0.02)):
            for _ in range(20):
                batch, self.in_transit = self.in_transit, []
                if shuffled:
                    self.random.shuffle(batch)
                for source, to, submessage in batch:
                    self.deliver(source, to, submessage)
                if not self.in_transit:
                    break
            self.now += 0.02
            self.writer.tick(self.now)
            for reader in self.readers.values():
                reader.tick(self.now)

    def deliver(self, source: bytes, to: bytes, submessage: object) -> None:
        if to == SERVER:
            if isinstance(submessage, AckNack):
                self.writer.on_acknack(source + READER, submessage, self.now)
            else:
                assert isinstance(submessage, NackFragments)
                self.writer.on_nack_fragments(source + READER, submessage, self.now)
        elif reader := self.readers.get(to):
            guid = source + WRITER
            match submessage:
                case Data():
                    reader.on_data(guid, submessage, self.now)
                case DataFragments():
                    reader.on_fragments(guid, submessage, self.now)
                case Heartbeat():
                    reader.on_heartbeat(guid, submessage, self.now)
                case Gap():
                    reader.on_gap(guid, submessage, self.now)


def test_a_sample_is_delivered_at_once_and_forgotten_when_acknowledged():
    network = Network()
    network.join(CLIENT)

    network.writer.write(b"one", network.now)
    network.run(0.02)

    assert network.delivered[CLIENT] == [b"one"]
    assert network.writer.pending == 0


@pytest.mark.parametrize("seed", range(8))
def test_all_samples_are_delivered_once_and_in_order_although_a_third_is_lost(seed):
    network = Network(loss=0.35, seed=seed)
    network.join(CLIENT)

    for number in range(100):
        network.writer.write(b"%d" % number, network.now)
        network.run(0.02, shuffled=True)
    network.run(20.0, shuffled=True)

    assert network.delivered[CLIENT] == [b"%d" % number for number in range(100)]
    assert network.writer.pending == 0


def test_a_reply_goes_to_its_reader_alone_and_others_do_not_wait_for_it():
    network = Network()
    network.join(CLIENT)
    network.join(OTHER)

    for number in range(5):
        network.writer.write(b"%d" % number, network.now, target=CLIENT + READER)
    network.writer.write(b"other", network.now, target=OTHER + READER)
    network.run(0.02)

    assert network.delivered == {CLIENT: [b"0", b"1", b"2", b"3", b"4"], OTHER: [b"other"]}
    assert network.writer.pending == 0


def test_a_reply_needs_no_second_message_after_replies_to_others():
    network = Network()
    network.join(CLIENT)
    network.join(OTHER)
    network.run(0.1)
    for target, payload in ((CLIENT, b"a"), (OTHER, b"b"), (CLIENT, b"c")):
        network.writer.write(payload, network.now, target=target + READER)

    for source, to, submessage in [each for each in network.in_transit if each[1] != SERVER]:
        network.deliver(source, to, submessage)

    assert network.delivered == {CLIENT: [b"a", b"c"], OTHER: [b"b"]}


def test_a_reader_does_not_wait_for_samples_that_its_writer_has_forgotten():
    network = Network()
    reader = network.join(CLIENT)

    reader.on_data(SERVER + WRITER, Data(READER, WRITER, 7, b"seven"), 0.0)
    reader.on_heartbeat(SERVER + WRITER, Heartbeat(READER, WRITER, 7, 7, 1), 0.0)

    assert network.delivered[CLIENT] == [b"seven"]


def test_a_reader_does_not_wait_for_samples_in_a_gap():
    network = Network()
    reader = network.join(CLIENT)

    reader.on_gap(SERVER + WRITER, Gap(READER, WRITER, 2, 4, (5,)), 0.0)
    for seq in (6, 4, 1):
        reader.on_data(SERVER + WRITER, Data(READER, WRITER, seq, b"%d" % seq), 0.0)

    assert network.delivered[CLIENT] == [b"1", b"4", b"6"]


def test_a_request_for_samples_of_another_reader_is_answered_by_a_gap():
    network = Network()
    network.join(CLIENT)
    network.join(OTHER)
    for target in (OTHER, CLIENT, OTHER, OTHER):
        network.writer.write(b"reply", network.now, target=target + READER)
    network.in_transit.clear()

    request = AckNack(READER, WRITER, 1, (1, 3, 4), 1)
    network.writer.on_acknack(CLIENT + READER, request, 1.0)

    assert network.in_transit == [(SERVER, CLIENT, Gap(READER, WRITER, 1, 2, (3, 4)))]


@pytest.mark.parametrize(("base", "final"), [(0, False), (1, False), (2, True)])
def test_a_greeting_gets_a_heartbeat_that_is_final_if_no_sample_is_missing(base, final):
    network = Network(transient_local=True)
    network.join(CLIENT)
    network.writer.write(b"endpoint", network.now)
    network.in_transit.clear()

    network.writer.on_acknack(CLIENT + READER, AckNack(READER, WRITER, base, (), 1, False), 1.0)

    ((_, _, beat),) = network.in_transit
    assert (beat.first, beat.last, beat.final) == (1, 1, final)


def test_a_reply_waits_for_a_reader_that_is_not_announced_yet():
    network = Network()

    network.writer.write(b"reply", network.now, target=CLIENT + READER)
    network.run(1.0)
    network.join(CLIENT)
    network.run(0.1)

    assert network.delivered[CLIENT] == [b"reply"]


def test_a_reply_to_a_client_that_never_comes_is_dropped():
    network = Network()

    network.writer.write(b"reply", network.now, target=CLIENT + READER)
    network.run(HISTORY_S + 0.1)

    assert network.writer.pending == 0


def test_a_reply_to_a_client_that_dies_is_dropped():
    network = Network()
    network.join(CLIENT)
    network.run(0.1)
    network.readers.clear()

    network.writer.write(b"reply", network.now, target=CLIENT + READER)
    network.run(1.0)
    network.writer.unmatch(CLIENT + READER)
    network.run(HISTORY_S)

    assert network.writer.pending == 0


def test_a_late_reader_receives_old_samples_only_of_a_transient_local_writer():
    volatile, transient_local = Network(), Network(transient_local=True)
    for network in (volatile, transient_local):
        network.writer.write(b"old", network.now)
        network.join(CLIENT)
        network.writer.write(b"new", network.now)
        network.run(0.2)

    assert volatile.delivered[CLIENT] == [b"new"]
    assert transient_local.delivered[CLIENT] == [b"old", b"new"]


def test_a_newer_sample_with_the_same_key_replaces_the_older_one():
    network = Network(transient_local=True)
    for payload in (b"first", b"second"):
        network.writer.write(payload, network.now, key=b"K" * 16)
    network.join(CLIENT)
    network.run(0.2)

    assert network.delivered[CLIENT] == [b"second"]


def test_a_reader_that_forgot_its_writer_receives_all_samples_again():
    network = Network(transient_local=True)
    network.writer.write(b"endpoint", network.now)
    network.join(CLIENT)
    network.run(1.0)

    network.join(CLIENT)  # it forgot the writer, whose lease had expired
    network.run(1.0)

    assert network.delivered[CLIENT] == [b"endpoint"]


def test_a_quiet_pair_sends_nothing():
    network = Network()
    network.join(CLIENT)
    network.writer.write(b"one", network.now)
    network.run(3.0)
    before = network.sent
    network.run(30.0)

    assert network.sent == before


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_a_long_sample_is_delivered_in_fragments(loss):
    network = Network(loss=loss, seed=3)
    network.join(CLIENT)
    payload = random.Random(1).randbytes(700_001)

    network.writer.write(payload, network.now, related=Sample(CLIENT + READER, 7))
    network.writer.write(b"after", network.now)
    network.run(60.0, shuffled=True)

    assert network.delivered[CLIENT] == [payload, b"after"]


def test_the_number_of_incomplete_samples_is_limited():
    network = Network()
    reader = network.join(CLIENT)
    for seq in range(1, 3 * MAX_ASSEMBLIES):
        part = DataFragments(READER, WRITER, seq, 1, 1, 4, MAX_SAMPLE_BYTES // 1024, b"abcd")
        reader.on_fragments(SERVER + WRITER, part, 0.0)

    (writer,) = reader.writers.values()
    assert len(writer.assemblies) == MAX_ASSEMBLIES
    reader.tick(100.0)
    assert not writer.assemblies


@pytest.mark.parametrize(("size", "fragment"), [(MAX_SAMPLE_BYTES + 1, 60_000), (1 << 20, 1)])
def test_a_sample_that_is_too_long_or_in_too_many_pieces_is_refused(size, fragment):
    network = Network()
    reader = network.join(CLIENT)

    part = DataFragments(READER, WRITER, 1, 1, 1, fragment, size, bytes(fragment))
    reader.on_fragments(SERVER + WRITER, part, 0.0)

    (writer,) = reader.writers.values()
    assert not writer.assemblies


def test_the_number_of_samples_out_of_order_is_limited():
    network = Network()
    reader = network.join(CLIENT)
    for seq in range(2, 10 * MAX_EARLY):
        reader.on_data(SERVER + WRITER, Data(READER, WRITER, seq, b"x"), 0.0)

    (writer,) = reader.writers.values()
    assert len(writer.early) < MAX_EARLY
    assert network.delivered[CLIENT] == []


def test_many_writers_share_the_limit_of_samples_out_of_order():
    network = Network()
    reader = network.join(CLIENT)
    for number in range(100):
        guid = number.to_bytes(12, "big") + WRITER
        reader.match(guid, AT, 0.0)
        for seq in range(2, 100):
            reader.on_data(guid, Data(READER, WRITER, seq, bytes(1000)), 0.0)
    kept = sum(len(writer.early) for writer in reader.writers.values())
    assert kept == MAX_ALL_EARLY

    for guid in list(reader.writers):
        if guid != SERVER + WRITER:
            reader.unmatch(guid)
    reader.on_data(SERVER + WRITER, Data(READER, WRITER, 2, b"second"), 0.0)
    reader.on_data(SERVER + WRITER, Data(READER, WRITER, 1, b"first"), 0.0)
    assert network.delivered[CLIENT] == [b"first", b"second"]


def test_a_huge_gap_takes_no_time():
    network = Network()
    reader = network.join(CLIENT)

    reader.on_gap(SERVER + WRITER, Gap(READER, WRITER, 1, 1 << 60), 0.0)
    reader.on_data(SERVER + WRITER, Data(READER, WRITER, 1 << 60, b"x"), 0.0)

    assert network.delivered[CLIENT] == [b"x"]


def test_the_history_of_a_writer_is_limited():
    network = Network()
    network.join(CLIENT)
    network.readers.clear()
    for number in range(3 * MAX_HISTORY):
        network.writer.write(b"%d" % number, network.now)
    assert network.writer.pending == MAX_HISTORY

    network.writer.write(bytes(9 << 20), network.now, target=OTHER)
    assert network.writer.pending == 0


def test_a_sample_is_sent_again_at_most_once_in_ten_milliseconds():
    network = Network()
    network.join(CLIENT)
    network.readers.clear()
    network.writer.write(bytes(1000), 1.0)
    network.sent = 0

    for number in range(100):
        request = AckNack(READER, WRITER, 1, (1,), number)
        network.writer.on_acknack(CLIENT + READER, request, 1.001)
    assert network.sent == 0

    network.writer.on_acknack(CLIENT + READER, AckNack(READER, WRITER, 1, (1,), 200), 1.02)
    assert network.sent == 1


def test_the_answer_to_one_request_for_samples_is_limited():
    network = Network()
    network.join(CLIENT)
    network.readers.clear()
    for _ in range(200):
        network.writer.write(bytes(30_000), 1.0)
    network.in_transit.clear()

    request = AckNack(READER, WRITER, 1, tuple(range(1, 201)), 1)
    network.writer.on_acknack(CLIENT + READER, request, 2.0)

    sizes = [len(each.payload) for _, _, each in network.in_transit if isinstance(each, Data)]
    assert sum(sizes) == 9 * 30_000


def test_unmatched_endpoints_get_no_answer():
    network = Network()
    reader = network.join(CLIENT)
    network.writer.write(b"one", network.now)
    network.sent = 0

    network.writer.on_acknack(OTHER + READER, AckNack(READER, WRITER, 1, (1,), 1, False), 0.0)
    network.writer.on_nack_fragments(OTHER + READER, NackFragments(READER, WRITER, 1, (1,), 1), 0)
    reader.on_heartbeat(OTHER + WRITER, Heartbeat(READER, WRITER, 1, 5, 1), 0.0)
    reader.on_data(OTHER + WRITER, Data(READER, WRITER, 1, b"no"), 0.0)

    assert (network.sent, network.delivered[CLIENT]) == (0, [])
