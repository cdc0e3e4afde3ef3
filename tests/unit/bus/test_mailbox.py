import asyncio
from collections.abc import AsyncIterator

import pytest

from gigabrain_zenoh.bus.bridge import MAX_KEYS, Bridge, Mailbox
from gigabrain_zenoh.testing.waiting import start_thread, until


class Hand:
    """Takes what a mailbox delivers."""

    def __init__(self) -> None:
        self.bridge = Bridge()
        self.got: list[int] = []

    async def until(self, count: int) -> None:
        await until(lambda: len(self.got) >= count)


@pytest.fixture
async def hand() -> AsyncIterator[Hand]:
    hand = Hand()
    yield hand
    hand.bridge.close()


async def test_a_mailbox_of_one_hands_a_busy_loop_the_newest_only(hand: Hand) -> None:
    mailbox = Mailbox(hand.bridge, hand.got.append, 1)
    for number in range(100):
        mailbox.put(number)
    await hand.until(1)
    mailbox.put(100)
    await hand.until(2)
    assert hand.got == [99, 100]


async def test_what_cannot_be_read_does_not_push_out_what_can(hand: Hand) -> None:
    def read(number: int) -> bool:
        hand.got.append(number)
        return number < 3

    mailbox = Mailbox(hand.bridge, read, 1)
    for number in range(7):
        mailbox.put(number)
    await hand.until(5)
    await asyncio.sleep(0)
    assert hand.got == [6, 5, 4, 3, 2]


async def test_a_deeper_mailbox_keeps_the_newest_in_order(hand: Hand) -> None:
    mailbox = Mailbox(hand.bridge, hand.got.append, 16)
    for number in range(100):
        mailbox.put(number)
    await hand.until(16)
    assert hand.got == list(range(84, 100))


async def test_a_busy_loop_is_handed_the_newest_of_each_key(hand: Hand) -> None:
    mailbox = Mailbox(hand.bridge, hand.got.append, 1)
    for number in range(100):
        mailbox.put(number, f"robot/perceived/{number % 3}")
    await hand.until(3)
    await asyncio.sleep(0)
    assert sorted(hand.got) == [97, 98, 99]


async def test_a_flood_of_keys_is_bounded_and_later_ones_are_delivered(hand: Hand) -> None:
    mailbox = Mailbox(hand.bridge, hand.got.append, 2)
    for number in range(10_000):
        mailbox.put(number, str(number))
    await hand.until(MAX_KEYS)
    mailbox.put(-1, "0")
    await hand.until(MAX_KEYS + 1)
    assert hand.got == [*range(10_000 - MAX_KEYS, 10_000), -1]


async def test_a_mailbox_that_is_flooded_lets_others_have_their_turn(hand: Hand) -> None:
    others: list[int] = []

    def refill(number: int) -> None:
        hand.got.append(number)
        if number < 5:
            mailbox.put(number + 1)
            asyncio.get_running_loop().call_soon(others.append, number)

    mailbox = Mailbox(hand.bridge, refill, 1)
    mailbox.put(0)
    await hand.until(6)
    assert others == [0, 1, 2, 3, 4]


async def test_a_mailbox_delivers_the_last_of_what_a_thread_puts(hand: Hand) -> None:
    mailbox = Mailbox(hand.bridge, hand.got.append, 1)

    def put() -> None:
        for number in range(50_000):
            mailbox.put(number)

    putting = start_thread(put)
    await until(lambda: hand.got[-1:] == [49_999])
    putting.join()
    assert hand.got == sorted(set(hand.got))
