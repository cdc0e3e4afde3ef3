"""The robot's time: the effects of one message, and of several."""

import asyncio

import pytest
from msgspec.structs import replace

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import PoseInMap
from gigabrain_schemas.topics import STATE
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.freshness import PreviousTick, RobotTime
from gigabrain_zenoh.bus.listening import Sampled
from gigabrain_zenoh.errors import ClockLost
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.samples import BOOT, open_space, scan, state

SECOND_NS = 1_000_000_000
FAR_FUTURE = 2**37


@pytest.fixture
def time() -> RobotTime:
    time = RobotTime()
    assert time.observe(state(100))
    return time


def test_one_state_of_the_far_future_is_not_believed(time: RobotTime) -> None:
    assert not time.observe(state(FAR_FUTURE))
    assert time.tick == 100
    assert time.observe(state(101))
    assert time.tick == 101


def test_one_scan_of_the_far_future_is_not_believed(time: RobotTime) -> None:
    assert not time.observe(scan(open_space(), FAR_FUTURE))
    assert time.tick == 100


def test_a_gap_of_up_to_a_second_needs_no_confirmation(time: RobotTime) -> None:
    assert time.observe(state(150))
    assert time.tick == 150


def test_a_jump_ahead_is_believed_once_the_third_state_agrees(time: RobotTime) -> None:
    assert [time.observe(state(tick)) for tick in (500, 501, 502)] == [False, False, True]
    assert time.tick == 502


def test_a_jump_is_not_believed_while_the_present_time_goes_on(time: RobotTime) -> None:
    for n in range(1, 50):
        assert not time.observe(state(FAR_FUTURE + n))
        assert time.observe(state(100 + n))
    assert time.tick == 149


def test_states_that_jump_about_confirm_nothing(time: RobotTime) -> None:
    assert not any(time.observe(state(1000 * n)) for n in range(1, 50))
    assert time.tick == 100


def test_another_boot_is_believed_once_the_third_message_agrees(time: RobotTime) -> None:
    assert not time.observe(state(1, boot=8))
    assert not time.observe(scan(open_space(), 1, boot=8))
    assert time.observe(state(2, boot=8))
    assert (time.boot, time.tick) == (8, 2)


def test_one_state_of_another_boot_changes_nothing(time: RobotTime) -> None:
    assert not time.observe(state(3, boot=8))
    assert time.observe(state(101))
    assert not time.observe(state(4, boot=8))
    assert (time.boot, time.tick) == (BOOT, 101)


def test_a_message_that_several_here_listen_to_counts_once(time: RobotTime) -> None:
    assert not any(time.observe(state(FAR_FUTURE)) for _ in range(10))


def test_a_first_tick_that_is_repeated_until_the_brain_is_there_is_believed(
    time: RobotTime,
) -> None:
    said = [replace(state(1, boot=8), seq=seq) for seq in (1, 2, 3)]
    assert [time.observe(one) for one in said] == [False, False, True]


def test_a_state_of_no_boot_is_refused_once_a_driver_has_been_heard(time: RobotTime) -> None:
    assert not time.observe(state(101, boot=0))
    assert RobotTime().observe(state(101, boot=0))


def test_time_does_not_go_back(time: RobotTime) -> None:
    assert not any(time.observe(state(tick)) for tick in range(1, 40))
    assert time.tick == 100


def test_what_came_before_is_still_known_after_a_message_of_the_future() -> None:
    places: PreviousTick[PoseInMap] = PreviousTick()

    def place(tick: int) -> PoseInMap:
        return PoseInMap(x=0.0, y=0.0, yaw=0.0, covariance=(0.0,) * 9, boot=BOOT, tick=tick)

    for tick in (10, FAR_FUTURE, 15):
        places.receive(place(tick))
    assert places.at(BOOT, 15, SECOND_NS) == place(10)
    assert places.at(BOOT, 16, SECOND_NS) == place(15)


def deliver_state(net: Net, message: RobotState) -> None:
    net.network.deliver(STATE.key, codec.encode(message))


async def test_who_refuses_every_state_for_three_seconds_says_so_and_ends() -> None:
    net = Net()
    states = net.one.latest(STATE)
    deliver_state(net, state(FAR_FUTURE))  # the first message is accepted
    for tick in range(1, 149):
        deliver_state(net, state(tick))
        await net.clock.advance(20_000_000)
    assert not net.one.failed.done()
    for tick in range(149, 155):
        deliver_state(net, state(tick))
        await net.clock.advance(20_000_000)
    assert states.newest == state(FAR_FUTURE)
    with pytest.raises(ClockLost, match=r"refused every robot/state for 3 s.* tick 152"):
        net.one.failed.result()


async def test_a_lie_now_and_then_ends_nobody() -> None:
    net = Net()
    net.one.latest(STATE)
    deliver_state(net, state(1))
    for n in range(20):
        deliver_state(net, state(FAR_FUTURE, boot=n + 20))
        await net.clock.advance(2 * SECOND_NS)
    assert not net.one.failed.done()


async def test_a_lie_reaches_no_reader_and_is_counted() -> None:
    net = Net()
    received = list[int]()
    net.one.latest(STATE, lambda state: received.append(state.tick))
    for tick in (100, FAR_FUTURE, 101):
        deliver_state(net, state(tick))
    await asyncio.sleep(0)
    assert received == [100, 101]
    assert net.one.counters["refused_ticks"] == 1


async def test_who_looks_seldom_confirms_a_jump_by_what_has_come_meanwhile() -> None:
    net = Net()
    sampled = Sampled(net.one, STATE)
    deliver_state(net, state(100))
    assert sampled.poll() == state(100)
    for tick in (500, 501, 502):
        deliver_state(net, state(tick))
    assert sampled.poll() == state(500)
    deliver_state(net, state(FAR_FUTURE))
    assert sampled.poll() is None
    deliver_state(net, state(503))
    assert sampled.poll() == state(503)
