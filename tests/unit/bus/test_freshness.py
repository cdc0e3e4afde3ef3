import pytest

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import Intent, Twist, WorldModel
from gigabrain_schemas.topics import INTENT, STATE, TELEOP, WORLD
from gigabrain_zenoh.bus.freshness import Latest, RobotTime
from gigabrain_zenoh.clock import FakeClock

MS = 1_000_000


def state(tick: int, boot: int = 7) -> RobotState:
    return RobotState(
        boot=boot,
        tick=tick,
        robot_type="mock",
        pose=Pose(x=0.0, y=0.0, yaw=0.0),
        velocity=Velocity(),
    )


def world(tick: int, boot: int = 7) -> WorldModel:
    return WorldModel(boot=boot, tick=tick, scan_ok=True, obstacle_ahead=False)


class Reader:
    """A clock, the robot's time, and what is held of three topics."""

    def __init__(self) -> None:
        self.clock, self.time = FakeClock(), RobotTime()
        self.states = Latest(STATE, self.clock, self.time)
        self.worlds = Latest(WORLD, self.clock, self.time)
        self.twists = Latest(TELEOP, self.clock, self.time)

    def see(self, tick: int, boot: int = 7) -> None:
        if self.time.observe(state(tick, boot)):
            self.states.store(state(tick, boot))

    def start_anew(self, tick: int, boot: int) -> None:
        """The driver starts again: its third state is at `tick`, and confirms the first two."""
        for each in (tick - 2, tick - 1, tick):
            self.see(each, boot)


@pytest.fixture
def reader() -> Reader:
    return Reader()


def test_nothing_is_fresh_before_anything_came(reader: Reader) -> None:
    assert reader.worlds.newest is None
    assert reader.worlds.current is None
    assert reader.worlds.age_ns() is None
    assert reader.worlds.fresh() is None


async def test_a_world_ages_by_the_tick_and_not_by_the_wall(reader: Reader) -> None:
    reader.see(100)
    assert reader.worlds.store(world(100))
    await reader.clock.advance(3_600_000 * MS)
    assert reader.worlds.age_ns() == 0
    reader.see(112)
    assert reader.worlds.age_ns() == 240 * MS
    assert reader.worlds.fresh() == world(100)
    reader.see(113)
    assert reader.worlds.age_ns() == 260 * MS
    assert reader.worlds.fresh() is None
    assert reader.worlds.current == world(100)


def test_a_message_that_was_old_when_it_came_is_as_old_as_its_tick_says(reader: Reader) -> None:
    reader.see(100)
    reader.worlds.store(world(87))
    assert reader.worlds.age_ns() == 260 * MS
    assert reader.worlds.fresh() is None


def test_a_tick_from_the_future_buys_no_more_than_100_ms(reader: Reader) -> None:
    reader.see(100)
    reader.worlds.store(world(2**62))
    assert reader.worlds.age_ns() == 0
    reader.see(117)
    assert reader.worlds.fresh() == world(2**62)
    reader.see(118)
    assert reader.worlds.fresh() is None


def test_whoever_lags_behind_does_not_take_a_new_message_for_an_old_one(reader: Reader) -> None:
    reader.see(100)
    reader.worlds.store(world(105))  # five states are still to be read
    reader.see(105)
    assert reader.worlds.age_ns() == 0


def test_a_tick_from_the_future_keeps_nothing_out(reader: Reader) -> None:
    reader.see(100)
    reader.worlds.store(world(2**62))
    assert reader.worlds.store(world(100))
    assert reader.worlds.fresh() == world(100)


def test_a_tick_from_the_future_does_not_keep_out_what_comes_a_little_late(
    reader: Reader,
) -> None:
    reader.see(100)
    reader.worlds.store(world(2**62))
    assert reader.worlds.store(world(99))
    assert reader.worlds.fresh() == world(99)


def test_an_older_tick_does_not_replace_a_newer_one(reader: Reader) -> None:
    reader.see(100)
    assert reader.worlds.store(world(99))
    assert not reader.worlds.store(world(98))
    assert reader.worlds.newest == world(99)
    assert reader.worlds.store(world(99))


async def test_the_state_ages_by_the_wall_as_well_since_nothing_else_tells_of_a_dead_driver(
    reader: Reader,
) -> None:
    reader.see(100)
    await reader.clock.advance(250 * MS)
    assert reader.states.fresh() == state(100)
    await reader.clock.advance(1)
    assert reader.states.age_ns() == 250 * MS + 1
    assert reader.states.fresh() is None


async def test_a_message_without_boot_ages_by_the_wall_and_by_the_tick_of_its_arrival(
    reader: Reader,
) -> None:
    reader.see(100)
    reader.twists.store(Twist(linear_x=0.2))
    assert reader.twists.age_ns() == 0
    reader.see(105)
    assert reader.twists.age_ns() == 100 * MS
    await reader.clock.advance(250 * MS)
    assert reader.twists.fresh() == Twist(linear_x=0.2)
    await reader.clock.advance(1)
    assert reader.twists.fresh() is None


def test_a_limit_of_the_readers_own_may_be_tighter(reader: Reader) -> None:
    reader.see(100)
    reader.worlds.store(world(95))
    assert reader.worlds.fresh(within_ns=100 * MS) == world(95)
    assert reader.worlds.fresh(within_ns=100 * MS - 1) is None


def test_a_new_start_of_the_driver_discards_all_that_is_held(reader: Reader) -> None:
    reader.see(5000)
    reader.worlds.store(world(5000))
    reader.start_anew(3, boot=8)
    assert (reader.time.boot, reader.time.tick) == (8, 3)
    assert reader.worlds.current is None
    assert reader.worlds.fresh() is None
    assert reader.states.fresh() == state(3, boot=8)


def test_a_world_of_a_new_start_waits_until_that_start_is_heard_of(reader: Reader) -> None:
    reader.see(10)
    reader.worlds.store(world(300, boot=8))
    assert reader.worlds.fresh() is None
    reader.start_anew(301, boot=8)
    assert reader.worlds.age_ns() == 20 * MS
    assert reader.worlds.fresh() == world(300, boot=8)


def test_the_robots_time_goes_forwards_within_a_start(reader: Reader) -> None:
    reader.see(100)
    reader.see(99)
    assert (reader.time.boot, reader.time.tick) == (7, 100)


def test_a_state_without_boot_does_not_move_the_robots_time(reader: Reader) -> None:
    reader.see(100)
    reader.see(3000, boot=0)
    assert (reader.time.boot, reader.time.tick) == (7, 100)


def test_an_intent_may_have_been_on_its_way_for_150_ms_but_not_silent_for_more_than_100(
    reader: Reader,
) -> None:
    intents = Latest(INTENT, reader.clock, reader.time)
    reader.see(107)
    intents.store(Intent(boot=7, tick=100, behaviour="avoid", reason="free"))
    assert intents.fresh() is not None  # 140 ms there and back
    reader.see(108)
    assert intents.fresh() is None
    intents.store(Intent(boot=7, tick=108, behaviour="avoid", reason="free"))
    reader.see(113)
    assert intents.fresh() is not None
    reader.see(114)
    assert intents.fresh() is None  # nothing came for 120 ms
