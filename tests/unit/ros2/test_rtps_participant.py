"""Participants find each other, match their endpoints, and bear whatever a datagram holds."""

import random
from collections import deque

import pytest

from gigabrain_zenoh.ros2.rtps_discovery import (
    PARTICIPANT,
    PUBLICATIONS_READER,
    PUBLICATIONS_WRITER,
    READER_KIND,
    SPDP_READER,
    SPDP_WRITER,
    WRITER_KIND,
    EndpointData,
    ParticipantData,
)
from gigabrain_zenoh.ros2.rtps_participant import MAX_ENDPOINTS, MAX_REMOTES, Participant
from gigabrain_zenoh.ros2.rtps_reader import ReliableReader
from gigabrain_zenoh.ros2.rtps_wire import (
    UNKNOWN_ENTITY,
    AckNack,
    Data,
    DataFragments,
    Gap,
    Heartbeat,
    HeartbeatFragments,
    NackFragments,
    Sample,
    encode_message,
)
from gigabrain_zenoh.ros2.rtps_writer import ReliableWriter


class Ether:
    """Hosts 10.0.0.1, 10.0.0.2, ..., each with one participant, and their datagrams."""

    def __init__(self, *, loss: float = 0.0) -> None:
        self.now, self.loss, self.random = 0.0, loss, random.Random(1)
        self.hosts: dict[str, Participant] = {}
        self.way: deque[tuple[str, str, bytes]] = deque()  # from, to, datagram

    def join(self, number: int) -> Participant:
        host = f"10.0.0.{number}"
        data = ParticipantData(
            b"\0\0" + number.to_bytes(10, "big"), ((host, 7410),), ((host, 7411),)
        )
        made = Participant(
            data,
            lambda datagram, to: self.way.append((host, to[0], datagram)),
            lambda datagram: self.way.extend(
                (host, to, datagram) for to in self.hosts if to != host
            ),
            lambda: 0,
        )
        made.move(data, [host, "127.0.0.1"])
        self.hosts[host] = made
        return made

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.05)):
            while self.way:
                source, to, datagram = self.way.popleft()
                if to in self.hosts and self.random.random() >= self.loss:
                    self.hosts[to].receive(datagram, source, self.now)
            self.now += 0.05
            for one in self.hosts.values():
                one.tick(self.now)

    def kill(self, participant: Participant) -> None:
        self.hosts = {host: one for host, one in self.hosts.items() if one is not participant}


def add_writer(ether: Ether, to: Participant, topic: str = "rq/aRequest") -> ReliableWriter:
    writer = ReliableWriter(to.next_entity(WRITER_KIND), to.send)
    data = EndpointData(to.data.prefix + writer.entity, topic, "T")
    to.add_writer(writer, data, ether.now)
    return writer


def add_reader(ether: Ether, to: Participant, topic: str = "rq/aRequest"):
    got: list[bytes] = []
    reader = ReliableReader(
        to.next_entity(READER_KIND), to.send, lambda _, one: got.append(one.payload)
    )
    data = EndpointData(to.data.prefix + reader.entity, topic, "T")
    to.add_reader(reader, data, ether.now)
    return reader, got


@pytest.mark.parametrize("loss", [0.0, 0.3])
@pytest.mark.parametrize("writer_first", [True, False])
def test_endpoints_find_each_other_in_either_order(loss, writer_first):
    ether = Ether(loss=loss)
    one, two = ether.join(1), ether.join(2)
    writer = add_writer(ether, one) if writer_first else None
    ether.run(3.0)
    reader, got = add_reader(ether, two)
    ether.run(5.0)
    writer = writer or add_writer(ether, one)
    ether.run(5.0)
    assert list(writer.readers) == [two.data.prefix + reader.entity]
    assert list(reader.writers) == [one.data.prefix + writer.entity]

    writer.write(b"12345678", ether.now)
    ether.run(3.0)

    assert got == [b"12345678"]


def test_only_endpoints_of_the_same_topic_match():
    ether = Ether()
    one, two = ether.join(1), ether.join(2)
    writer = add_writer(ether, one)
    add_reader(ether, two, "rq/bRequest")
    ether.run(1.0)

    assert not writer.readers


def test_endpoints_of_topics_that_are_no_services_are_not_kept():
    ether = Ether()
    one, two = ether.join(1), ether.join(2)
    add_writer(ether, one, "rt/scan")
    ether.run(1.0)

    (remote,) = two.remotes.values()
    assert not remote.endpoints


def test_a_withdrawn_endpoint_is_unmatched():
    ether = Ether()
    one, two = ether.join(1), ether.join(2)
    writer = add_writer(ether, one)
    reader, _ = add_reader(ether, two)
    ether.run(1.0)
    two.remove(reader.entity, ether.now)
    ether.run(1.0)

    assert not writer.readers
    assert not next(iter(one.remotes.values())).endpoints


def test_a_participant_that_leaves_is_forgotten_at_once():
    ether = Ether()
    one, two = ether.join(1), ether.join(2)
    writer = add_writer(ether, one)
    add_reader(ether, two)
    ether.run(1.0)
    two.leave()
    ether.kill(two)
    ether.run(0.1)

    assert not one.remotes
    assert not writer.readers


def test_a_participant_that_dies_is_forgotten_after_its_lease():
    ether = Ether()
    one, two = ether.join(1), ether.join(2)
    writer = add_writer(ether, one)
    add_reader(ether, two)
    ether.run(1.0)
    ether.kill(two)

    ether.run(9.0)
    assert one.remotes
    ether.run(2.0)
    assert not one.remotes
    assert not writer.readers


def test_nothing_is_sent_to_a_participant_that_is_gone():
    ether = Ether()
    one, two = ether.join(1), ether.join(2)
    add_writer(ether, one)
    add_reader(ether, two)
    ether.run(1.0)
    ether.kill(two)
    ether.run(0.05)
    add_writer(ether, one, "rq/bRequest")  # is never acknowledged
    ether.run(12.0)
    ether.way.clear()
    for _ in range(200):
        ether.now += 0.05
        one.tick(ether.now)

    assert not [to for _, to, _ in ether.way if to == "10.0.0.2"]


def test_a_participant_is_answered_at_once_when_it_is_found():
    ether = Ether()
    one, two = ether.join(1), ether.join(2)
    add_reader(ether, two)
    writer = add_writer(ether, one)
    two._announce = lambda datagram: None
    ether.run(0.5)

    assert len(writer.readers) == 1


def test_a_participant_that_is_started_again_is_found_within_a_second():
    ether = Ether()
    one, two = ether.join(1), ether.join(2)
    writer = add_writer(ether, one)
    add_reader(ether, two)
    ether.run(30.0)
    ether.kill(two)
    again = ether.join(3)
    _, got = add_reader(ether, again)
    ether.run(1.0)

    writer.write(b"here", ether.now)
    ether.run(0.1)
    assert got == [b"here"]


def test_a_participant_that_was_away_for_longer_than_its_lease_is_found_again():
    ether = Ether()
    one, two = ether.join(1), ether.join(2)
    writer = add_writer(ether, one)
    _, got = add_reader(ether, two)
    ether.run(1.0)
    ether.loss = 1.0
    ether.run(12.0)
    assert not one.remotes
    ether.loss = 0.0
    ether.run(3.0)

    writer.write(b"then", ether.now)
    ether.run(0.1)
    assert got == [b"then"]


def test_a_host_that_gets_another_address_is_reached_there():
    ether = Ether()
    one, two = ether.join(1), ether.join(2)
    writer = add_writer(ether, one)
    _, got = add_reader(ether, two)
    ether.run(1.0)
    ether.hosts["10.0.0.9"] = ether.hosts.pop("10.0.0.2")
    moved = ParticipantData(two.data.prefix, (("10.0.0.9", 7410),), (("10.0.0.9", 7411),))
    two.move(moved, ["10.0.0.9"])
    two._announce = lambda datagram: ether.way.append(("10.0.0.9", "10.0.0.1", datagram))
    ether.run(1.0)

    writer.write(b"here", ether.now)
    ether.run(0.1)
    assert got == [b"here"]


@pytest.mark.slow
def test_sixty_participants_with_four_services_find_each_other():
    ether = Ether()
    everyone = [ether.join(number) for number in range(1, 61)]
    for number, one in enumerate(everyone):
        for service in range(4):
            add_reader(ether, one, f"rq/n{number}/s{service}Request")
    writers = [add_writer(ether, everyone[0], f"rq/n{number}/s0Request") for number in range(1, 60)]
    ether.run(1.5)

    assert all(len(one.remotes) == 59 for one in everyone)
    assert all(len(writer.readers) == 1 for writer in writers)


def announcement(prefix: bytes, host: str) -> bytes:
    data = ParticipantData(prefix, ((host, 7410),), ((host, 7411),))
    return encode_message(prefix, b"", [Data(SPDP_READER, SPDP_WRITER, 1, data.encode())], 0)


def test_nothing_is_sent_to_a_host_that_did_not_announce_itself():
    ether = Ether()
    one = ether.join(1)

    one.receive(announcement(b"\0\0" + b"v" * 10, "198.51.100.7"), "10.0.0.66", ether.now)

    assert not one.remotes
    assert not ether.way


def test_no_host_speaks_for_a_participant_of_another_host():
    ether = Ether()
    one, two = ether.join(1), ether.join(2)
    writer = add_writer(ether, one)
    add_reader(ether, two)
    ether.run(3.0)
    gone = Data(SPDP_READER, SPDP_WRITER, 9, b"", None, 3, two.data.prefix + PARTICIPANT)
    ask = AckNack(READER_OF_TWO, writer.entity, 1, (), 1, False)
    ether.way.clear()

    for submessage in (gone, ask):
        datagram = encode_message(two.data.prefix, one.data.prefix, [submessage], 0)
        one.receive(datagram, "10.0.0.66", ether.now)

    assert two.data.prefix in one.remotes
    assert not ether.way


READER_OF_TWO = b"\0\0\1\4"


def test_the_number_of_remote_participants_is_bounded():
    ether = Ether()
    one = ether.join(1)
    for number in range(2 * MAX_REMOTES):
        prefix = b"\0\0" + number.to_bytes(10, "big")
        host = f"10.0.7.{number % 200}"
        one.receive(announcement(b"x" + prefix[1:], host), host, ether.now)

    assert len(one.remotes) == MAX_REMOTES


def test_one_host_cannot_take_the_place_of_all_others():
    ether = Ether()
    one, two = ether.join(1), ether.join(2)
    for number in range(2 * MAX_REMOTES):
        prefix = b"x" + number.to_bytes(11, "big")
        one.receive(announcement(prefix, "10.0.0.66"), "10.0.0.66", ether.now)
    ether.run(1.0)

    assert two.data.prefix in one.remotes
    assert len(one.remotes) == 121  # as many as have ports on a host


def test_an_endpoint_of_another_participant_is_not_believed():
    ether = Ether()
    one = ether.join(1)
    prefix = b"\0\0" + b"m" * 10
    one.receive(announcement(prefix, "10.0.0.66"), "10.0.0.66", ether.now)
    foreign = EndpointData(b"\0\0" + b"z" * 10 + b"\0\0\1\3", "rq/aRequest", "T")
    data = Data(PUBLICATIONS_READER, PUBLICATIONS_WRITER, 1, foreign.encode())
    one.receive(encode_message(prefix, b"", [data], 0), "10.0.0.66", ether.now)

    assert not one.remotes[prefix].endpoints


def samples(prefix: bytes) -> list[bytes]:
    """Return datagrams of each kind from a participant at 10.0.0.66."""
    reader, writer = b"\0\0\1\4", b"\0\0\2\3"
    endpoint = EndpointData(prefix + b"\0\0\7\3", "rq/aRequest", "T", locators=())
    related = Sample(prefix + reader, 3)
    submessages = [
        Data(PUBLICATIONS_READER, PUBLICATIONS_WRITER, 1, endpoint.encode(), None, 0, b""),
        Data(UNKNOWN_ENTITY, b"\0\0\7\3", 1, b"\0\1\0\0abcd", related),
        DataFragments(UNKNOWN_ENTITY, b"\0\0\7\3", 2, 1, 1, 4, 12, b"abcd", related),
        Heartbeat(UNKNOWN_ENTITY, b"\0\0\7\3", 1, 5, 1),
        Heartbeat(UNKNOWN_ENTITY, PUBLICATIONS_WRITER, 1, 5, 1),
        AckNack(PUBLICATIONS_READER, PUBLICATIONS_WRITER, 1, (1, 2), 1, False),
        AckNack(reader, writer, 1, (1, 3), 1, False),
        Gap(UNKNOWN_ENTITY, b"\0\0\7\3", 1, 3, (5,)),
        NackFragments(reader, writer, 1, (1, 2), 3),
        HeartbeatFragments(UNKNOWN_ENTITY, b"\0\0\7\3", 2, 60, 3),
    ]
    each = [encode_message(prefix, b"", [one], 0) for one in submessages]
    return [announcement(prefix, "10.0.0.66"), *each, encode_message(prefix, b"", submessages, 0)]


def mutated(rng: random.Random, datagram: bytes) -> bytes:
    data = bytearray(datagram)
    for _ in range(rng.choice((1, 1, 2, 8))):
        at = rng.randrange(20, len(data))  # the header names the sender
        match rng.randrange(5):
            case 0:
                data[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
            case 1:
                del data[at : at + rng.randrange(1, 9)]
            case 2:
                data[at:at] = rng.randbytes(rng.randrange(1, 9))
            case 3:
                data[at : at + 4] = rng.choice((b"\xff\xff\xff\x7f", b"\xff" * 4, bytes(4)))
            case 4:
                del data[at:]
        if len(data) < 21:
            break
    return bytes(data)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_mutated_datagrams_raise_nothing_and_are_not_amplified(seed):
    rng, ether = random.Random(seed), Ether()
    one = ether.join(1)
    writer = add_writer(ether, one, "rr/aReply")
    add_reader(ether, one)
    prefix = b"\0\0" + b"m" * 10
    seeds = samples(prefix)
    received = 0
    for number in range(15_000):
        datagram = mutated(rng, rng.choice(seeds))
        one.receive(datagram, "10.0.0.66", ether.now)
        received += len(datagram)
        if number % 100 == 0:
            ether.now += 0.01
            one.tick(ether.now)
            writer.write(b"\0\1\0\0" + bytes(8), ether.now, target=prefix)
    sent = sum(len(datagram) for _, to, datagram in ether.way if to == "10.0.0.66")
    assert {to for _, to, _ in ether.way} <= {"10.0.0.66"}
    assert sent < 2 * received
    (remote,) = one.remotes.values()
    assert len(remote.endpoints) <= MAX_ENDPOINTS

    two = ether.join(2)  # and it still works
    _, got = add_reader(ether, two, "rr/aReply")
    ether.way.clear()
    ether.run(3.0)
    writer.write(b"fine", ether.now)
    ether.run(0.2)
    assert got == [b"fine"]


def test_sequence_numbers_at_the_end_of_their_range_raise_nothing():
    ether = Ether()
    one = ether.join(1)
    reader, _ = add_reader(ether, one)
    prefix, last = b"\0\0" + b"m" * 10, (1 << 63) - 1
    entity = b"\0\0\7\3"
    endpoint = EndpointData(prefix + entity, "rq/aRequest", "T")
    datagrams = [announcement(prefix, "10.0.0.66")] + [
        encode_message(prefix, b"", [each], 0)
        for each in (
            Data(PUBLICATIONS_READER, PUBLICATIONS_WRITER, 1, endpoint.encode()),
            Heartbeat(UNKNOWN_ENTITY, entity, last, last, 1),
            Gap(UNKNOWN_ENTITY, entity, 1, last),
            Data(UNKNOWN_ENTITY, entity, last, b"x"),
            Heartbeat(UNKNOWN_ENTITY, entity, last, last, 2),
        )
    ]
    for datagram in datagrams:
        one.receive(datagram, "10.0.0.66", ether.now)
    assert prefix + entity in reader.writers


def test_random_datagrams_raise_nothing():
    rng, ether = random.Random(5), Ether()
    one = ether.join(1)
    for _ in range(20_000):
        size = rng.randrange(64)
        one.receive(b"RTPS\2\3\0\0" + rng.randbytes(size), "10.0.0.66", ether.now)

    assert not one.remotes
    assert not ether.way
