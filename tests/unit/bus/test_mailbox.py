import asyncio
from collections.abc import AsyncIterator

import pytest

from gigabrain_zenoh.bus.bridge import MAX_KEYS, Bridge, Mailbox
from gigabrain_zenoh.testing.waiting import start_thread, until


class Receiver:
    """Receives the samples of a mailbox."""

    def __init__(self) -> None:
        self.bridge = Bridge()
        self.received: list[int] = []

    async def until(self, count: int) -> None:
        await until(lambda: len(self.received) >= count)


@pytest.fixture
async def receiver() -> AsyncIterator[Receiver]:
    receiver = Receiver()
    yield receiver
    receiver.bridge.close()


async def test_a_mailbox_of_one_hands_a_busy_loop_the_newest_only(receiver: Receiver) -> None:
    mailbox = Mailbox(receiver.bridge, receiver.received.append, 1)
    for number in range(100):
        mailbox.put(number)
    await receiver.until(1)
    mailbox.put(100)
    await receiver.until(2)
    assert receiver.received == [99, 100]


async def test_a_lazy_mailbox_waits_for_a_post_that_wakes_the_loop(receiver: Receiver) -> None:
    lazy = Mailbox(receiver.bridge, receiver.received.append, 4, lazy=True)
    for number in range(3):
        lazy.put(number)
    for _ in range(10):  # turns of the loop
        await asyncio.sleep(0)
    assert receiver.received == []
    Mailbox(receiver.bridge, receiver.received.append, 1).put(100)
    lazy.put(3)  # before the loop wakes: in the order of arrival, it belongs to the first ones
    await receiver.until(5)
    assert receiver.received == [0, 1, 2, 3, 100]


async def test_what_cannot_be_read_does_not_push_out_what_can(receiver: Receiver) -> None:
    def read(number: int) -> bool:
        receiver.received.append(number)
        return number < 3

    mailbox = Mailbox(receiver.bridge, read, 1)
    for number in range(7):
        mailbox.put(number)
    await receiver.until(5)
    await asyncio.sleep(0)
    assert receiver.received == [6, 5, 4, 3, 2]


async def test_a_deeper_mailbox_keeps_the_newest_in_order(receiver: Receiver) -> None:
    mailbox = Mailbox(receiver.bridge, receiver.received.append, 16)
    for number in range(100):
        mailbox.put(number)
    await receiver.until(16)
    assert receiver.received == list(range(84, 100))


async def test_a_busy_loop_is_handed_the_newest_of_each_key(receiver: Receiver) -> None:
    mailbox = Mailbox(receiver.bridge, receiver.received.append, 1)
    for number in range(100):
        mailbox.put(number, f"robot/perceived/{number % 3}")
    await receiver.until(3)
    await asyncio.sleep(0)
    assert sorted(receiver.received) == [97, 98, 99]


async def test_a_flood_of_keys_is_bounded_and_later_ones_are_delivered(receiver: Receiver) -> None:
    mailbox = Mailbox(receiver.bridge, receiver.received.append, 2)
    for number in range(10_000):
        mailbox.put(number, str(number))
    await receiver.until(MAX_KEYS)
    mailbox.put(-1, "0")
    await receiver.until(MAX_KEYS + 1)
    assert receiver.received == [*range(10_000 - MAX_KEYS, 10_000), -1]


async def test_a_mailbox_that_is_flooded_lets_others_have_their_turn(receiver: Receiver) -> None:
    others: list[int] = []

    def refill(number: int) -> None:
        receiver.received.append(number)
        if number < 5:
            mailbox.put(number + 1)
            asyncio.get_running_loop().call_soon(others.append, number)

    mailbox = Mailbox(receiver.bridge, refill, 1)
    mailbox.put(0)
    await receiver.until(6)
    assert others == [0, 1, 2, 3, 4]


async def test_a_mailbox_delivers_the_last_of_what_a_thread_puts(receiver: Receiver) -> None:
    mailbox = Mailbox(receiver.bridge, receiver.received.append, 1)

    def put() -> None:
        for number in range(50_000):
            mailbox.put(number)

    putting = start_thread(put)
    await until(lambda: receiver.received[-1:] == [49_999])
    putting.join()
    assert receiver.received == sorted(set(receiver.received))
