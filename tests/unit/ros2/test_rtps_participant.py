"""Participants find each other, match their endpoints, and tolerate malformed datagrams."""

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


class Network:
    """Hosts 10.0.0.1, 10.0.0.2, ..., each with one participant, and datagrams in transit."""

    def __init__(self, *, loss: float = 0.0) -> None:
        self.now, self.loss, self.random = 0.0, loss, random.Random(1)
        self.hosts: dict[str, Participant] = {}
        self.in_transit: deque[tuple[str, str, bytes]] = deque()  # from, to, datagram

    def join(self, number: int) -> Participant:
        host = f"10.0.0.{number}"
        data = ParticipantData(
            b"\0\0" + number.to_bytes(10, "big"), ((host, 7410),), ((host, 7411),)
        )
        participant = Participant(
            data,
            lambda datagram, to: self.in_transit.append((host, to[0], datagram)),
            lambda datagram: self.in_transit.extend(
                (host, to, datagram) for to in self.hosts if to != host
            ),
            lambda: 0,
        )
        participant.move(data, [host, "127.0.0.1"])
        self.hosts[host] = participant
        return participant

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.05)):
            while self.in_transit:
                source, to, datagram = self.in_transit.popleft()
                if to in self.hosts and self.random.random() >= self.loss:
                    self.hosts[to].receive(datagram, source, self.now)
            self.now += 0.05
            for participant in self.hosts.values():
                participant.tick(self.now)

    def kill(self, participant: Participant) -> None:
        self.hosts = {host: each for host, each in self.hosts.items() if each is not participant}


def add_writer(network: Network, to: Participant, topic: str = "rq/aRequest") -> ReliableWriter:
    writer = ReliableWriter(to.next_entity(WRITER_KIND), to.send)
    data = EndpointData(to.data.prefix + writer.entity, topic, "T")
    to.add_writer(writer, data, network.now)
    return writer


def add_reader(network: Network, to: Participant, topic: str = "rq/aRequest"):
    delivered: list[bytes] = []
    reader = ReliableReader(
        to.next_entity(READER_KIND), to.send, lambda _, data: delivered.append(data.payload)
    )
    data = EndpointData(to.data.prefix + reader.entity, topic, "T")
    to.add_reader(reader, data, network.now)
    return reader, delivered


@pytest.mark.parametrize("loss", [0.0, 0.3])
@pytest.mark.parametrize("writer_first", [True, False])
def test_endpoints_find_each_other_in_either_order(loss, writer_first):
    network = Network(loss=loss)
    one, two = network.join(1), network.join(2)
    writer = add_writer(network, one) if writer_first else None
    network.run(3.0)
    reader, delivered = add_reader(network, two)
    network.run(5.0)
    writer = writer or add_writer(network, one)
    network.run(5.0)
    assert list(writer.readers) == [two.data.prefix + reader.entity]
    assert list(reader.writers) == [one.data.prefix + writer.entity]

    writer.write(b"12345678", network.now)
    network.run(3.0)

    assert delivered == [b"12345678"]


def test_only_endpoints_of_the_same_topic_match():
    network = Network()
    one, two = network.join(1), network.join(2)
    writer = add_writer(network, one)
    add_reader(network, two, "rq/bRequest")
    network.run(1.0)

    assert not writer.readers


def test_endpoints_of_topics_that_are_not_services_are_ignored():
    network = Network()
    one, two = network.join(1), network.join(2)
    add_writer(network, one, "rt/scan")
    network.run(1.0)

    (remote,) = two.remotes.values()
    assert not remote.endpoints


def test_a_withdrawn_endpoint_is_unmatched():
    network = Network()
    one, two = network.join(1), network.join(2)
    writer = add_writer(network, one)
    reader, _ = add_reader(network, two)
    network.run(1.0)
    two.remove(reader.entity, network.now)
    network.run(1.0)

    assert not writer.readers
    assert not next(iter(one.remotes.values())).endpoints


def test_a_participant_that_leaves_is_forgotten_at_once():
    network = Network()
    one, two = network.join(1), network.join(2)
    writer = add_writer(network, one)
    add_reader(network, two)
    network.run(1.0)
    two.leave()
    network.kill(two)
    network.run(0.1)

    assert not one.remotes
    assert not writer.readers


def test_a_participant_that_dies_is_forgotten_after_its_lease():
    network = Network()
    one, two = network.join(1), network.join(2)
    writer = add_writer(network, one)
    add_reader(network, two)
    network.run(1.0)
    network.kill(two)

    network.run(9.0)
    assert one.remotes
    network.run(2.0)
    assert not one.remotes
    assert not writer.readers


def test_nothing_is_sent_to_a_participant_whose_lease_has_expired():
    network = Network()
    one, two = network.join(1), network.join(2)
    add_writer(network, one)
    add_reader(network, two)
    network.run(1.0)
    network.kill(two)
    network.run(0.05)
    add_writer(network, one, "rq/bRequest")  # is never acknowledged
    network.run(12.0)
    network.in_transit.clear()
    for _ in range(200):
        network.now += 0.05
        one.tick(network.now)

    assert not [to for _, to, _ in network.in_transit if to == "10.0.0.2"]


def test_a_new_participant_gets_an_announcement_at_once():
    network = Network()
    one, two = network.join(1), network.join(2)
    add_reader(network, two)
    writer = add_writer(network, one)
    two._announce = lambda datagram: None
    network.run(0.5)

    assert len(writer.readers) == 1


def test_a_restarted_participant_is_found_within_a_second():
    network = Network()
    one, two = network.join(1), network.join(2)
    writer = add_writer(network, one)
    add_reader(network, two)
    network.run(30.0)
    network.kill(two)
    again = network.join(3)
    _, delivered = add_reader(network, again)
    network.run(1.0)

    writer.write(b"here", network.now)
    network.run(0.1)
    assert delivered == [b"here"]


def test_a_participant_that_was_away_for_longer_than_its_lease_is_found_again():
    network = Network()
    one, two = network.join(1), network.join(2)
    writer = add_writer(network, one)
    _, delivered = add_reader(network, two)
    network.run(1.0)
    network.loss = 1.0
    network.run(12.0)
    assert not one.remotes
    network.loss = 0.0
    network.run(3.0)

    writer.write(b"then", network.now)
    network.run(0.1)
    assert delivered == [b"then"]


def test_a_host_is_reached_at_its_new_address():
    network = Network()
    one, two = network.join(1), network.join(2)
    writer = add_writer(network, one)
    _, delivered = add_reader(network, two)
    network.run(1.0)
    network.hosts["10.0.0.9"] = network.hosts.pop("10.0.0.2")
    moved = ParticipantData(two.data.prefix, (("10.0.0.9", 7410),), (("10.0.0.9", 7411),))
    two.move(moved, ["10.0.0.9"])
    two._announce = lambda datagram: network.in_transit.append(("10.0.0.9", "10.0.0.1", datagram))
    network.run(1.0)

    writer.write(b"here", network.now)
    network.run(0.1)
    assert delivered == [b"here"]


@pytest.mark.slow
def test_sixty_participants_with_four_services_find_each_other():
    network = Network()
    participants = [network.join(number) for number in range(1, 61)]
    for number, participant in enumerate(participants):
        for service in range(4):
            add_reader(network, participant, f"rq/n{number}/s{service}Request")
    writers = [
        add_writer(network, participants[0], f"rq/n{number}/s0Request") for number in range(1, 60)
    ]
    network.run(1.5)

    assert all(len(each.remotes) == 59 for each in participants)
    assert all(len(writer.readers) == 1 for writer in writers)


def announcement(prefix: bytes, host: str) -> bytes:
    data = ParticipantData(prefix, ((host, 7410),), ((host, 7411),))
    return encode_message(prefix, b"", [Data(SPDP_READER, SPDP_WRITER, 1, data.encode())], 0)


def test_nothing_is_sent_to_a_host_that_did_not_announce_itself():
    network = Network()
    one = network.join(1)

    one.receive(announcement(b"\0\0" + b"v" * 10, "198.51.100.7"), "10.0.0.66", network.now)

    assert not one.remotes
    assert not network.in_transit


def test_datagrams_of_a_participant_from_another_host_are_ignored():
    network = Network()
    one, two = network.join(1), network.join(2)
    writer = add_writer(network, one)
    add_reader(network, two)
    network.run(3.0)
    disposal = Data(SPDP_READER, SPDP_WRITER, 9, b"", None, 3, two.data.prefix + PARTICIPANT)
    acknack = AckNack(READER_OF_TWO, writer.entity, 1, (), 1, False)
    network.in_transit.clear()

    for submessage in (disposal, acknack):
        datagram = encode_message(two.data.prefix, one.data.prefix, [submessage], 0)
        one.receive(datagram, "10.0.0.66", network.now)

    assert two.data.prefix in one.remotes
    assert not network.in_transit


READER_OF_TWO = b"\0\0\1\4"


def test_the_number_of_remote_participants_is_limited():
    network = Network()
    one = network.join(1)
    for number in range(2 * MAX_REMOTES):
        prefix = b"\0\0" + number.to_bytes(10, "big")
        host = f"10.0.7.{number % 200}"
        one.receive(announcement(b"x" + prefix[1:], host), host, network.now)

    assert len(one.remotes) == MAX_REMOTES


def test_one_host_cannot_use_up_the_limit_of_participants():
    network = Network()
    one, two = network.join(1), network.join(2)
    for number in range(2 * MAX_REMOTES):
        prefix = b"x" + number.to_bytes(11, "big")
        one.receive(announcement(prefix, "10.0.0.66"), "10.0.0.66", network.now)
    network.run(1.0)

    assert two.data.prefix in one.remotes
    assert len(one.remotes) == 121  # 120, as many as have ports on a host, and `two`


def test_a_participant_cannot_announce_an_endpoint_of_another():
    network = Network()
    one = network.join(1)
    prefix = b"\0\0" + b"m" * 10
    one.receive(announcement(prefix, "10.0.0.66"), "10.0.0.66", network.now)
    foreign = EndpointData(b"\0\0" + b"z" * 10 + b"\0\0\1\3", "rq/aRequest", "T")
    data = Data(PUBLICATIONS_READER, PUBLICATIONS_WRITER, 1, foreign.encode())
    one.receive(encode_message(prefix, b"", [data], 0), "10.0.0.66", network.now)

    assert not one.remotes[prefix].endpoints


def valid_datagrams(prefix: bytes) -> list[bytes]:
    """Return a datagram of each kind from a participant at 10.0.0.66."""
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
    single = [encode_message(prefix, b"", [each], 0) for each in submessages]
    return [announcement(prefix, "10.0.0.66"), *single, encode_message(prefix, b"", submessages, 0)]


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
    rng, network = random.Random(seed), Network()
    one = network.join(1)
    writer = add_writer(network, one, "rr/aReply")
    add_reader(network, one)
    prefix = b"\0\0" + b"m" * 10
    seeds = valid_datagrams(prefix)
    received = 0
    for number in range(15_000):
        datagram = mutated(rng, rng.choice(seeds))
        one.receive(datagram, "10.0.0.66", network.now)
        received += len(datagram)
        if number % 100 == 0:
            network.now += 0.01
            one.tick(network.now)
            writer.write(b"\0\1\0\0" + bytes(8), network.now, target=prefix)
    sent = sum(len(datagram) for _, to, datagram in network.in_transit if to == "10.0.0.66")
    assert {to for _, to, _ in network.in_transit} <= {"10.0.0.66"}
    assert sent < 2 * received
    (remote,) = one.remotes.values()
    assert len(remote.endpoints) <= MAX_ENDPOINTS

    two = network.join(2)  # the participant still works
    _, delivered = add_reader(network, two, "rr/aReply")
    network.in_transit.clear()
    network.run(3.0)
    writer.write(b"fine", network.now)
    network.run(0.2)
    assert delivered == [b"fine"]


def test_sequence_numbers_at_the_end_of_their_range_raise_nothing():
    network = Network()
    one = network.join(1)
    reader, _ = add_reader(network, one)
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
        one.receive(datagram, "10.0.0.66", network.now)
    assert prefix + entity in reader.writers


def test_random_datagrams_raise_nothing():
    rng, network = random.Random(5), Network()
    one = network.join(1)
    for _ in range(20_000):
        size = rng.randrange(64)
        one.receive(b"RTPS\2\3\0\0" + rng.randbytes(size), "10.0.0.66", network.now)

    assert not one.remotes
    assert not network.in_transit
