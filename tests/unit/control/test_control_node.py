"""Control on the bus: whom it listens to, for how long, and that no message's speed matters."""

import itertools

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Message, Velocity
from gigabrain_schemas.body import ControlGains, GateStatus
from gigabrain_schemas.brain import Intent, JointSpeeds, Twist
from gigabrain_schemas.safety import SafetyState, SpeedCaps
from gigabrain_schemas.topics import BODY, CMD_VEL, INTENT, SAFETY, STATE, TELEOP, Topic
from gigabrain_zenoh.bus.freshness import PreviousTick
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.control.node import caps_at
from gigabrain_zenoh.control.teleop import OperatorStream, Teleop
from gigabrain_zenoh.geometry.limits import NO_CAPS
from gigabrain_zenoh.testing.in_memory import NodeBench
from gigabrain_zenoh.testing.samples import BOOT, DRIVING, TICK_NS, WAFFLE, body, state

MS = 1_000_000


def intent(tick: int, v: float = 0.2, *, basis: int | None = None, boot: int = BOOT) -> Intent:
    return Intent(
        twist=Velocity(linear_x=v),
        behaviour="avoid",
        reason="because",
        boot=boot,
        tick=tick,
        basis=tick if basis is None else basis,
    )


def verdict(tick: int, forward: float | None = None, *, boot: int = BOOT) -> SafetyState:
    return SafetyState(verdict="ok", caps=SpeedCaps(forward=forward), boot=boot, tick=tick)


class Chain(NodeBench):
    """Control, with the messages that drive it, and a body that follows at once."""

    def __init__(self) -> None:
        super().__init__(control.run)
        self.tick, self._speeds = 0, [0.0]

    async def go(
        self,
        ticks: int = 1,
        *,
        v: float | None = None,
        teleop: Twist | None = None,
        gate: GateStatus = DRIVING,
    ) -> list[float]:
        """So many ticks of a decision that wants `v`; the speeds that came of it."""
        self._speeds = self._speeds[-1:]
        for _ in range(ticks):
            self.tick += 1
            if teleop and self.tick % 2 == 0:
                self.send(TELEOP, teleop)
            self.send(STATE, state(self.tick, v=self._speeds[-1], gate=gate))
            self._speeds += [command.linear_x for command in self.sent(CMD_VEL)]
            if v is not None:
                self.send(INTENT, intent(self.tick, v, basis=1))
            await self.clock.advance(TICK_NS)
        return self._speeds[1:]


async def test_it_commands_once_per_state_and_at_once_when_decision_has_thought_again() -> None:
    async with Chain() as chain:
        chain.send(BODY, body())
        chain.send(STATE, state(9))
        chain.send(STATE, state(10))
        assert [(c.tick, c.basis) for c in chain.sent(CMD_VEL)] == [(9, 0), (10, 0)]
        chain.send(INTENT, intent(10))
        (command,) = chain.sent(CMD_VEL)
        assert (command.tick, command.basis, command.source) == (10, 10, "control")
        assert command.linear_x == pytest.approx(0.02)
        chain.send(INTENT, intent(10))  # only repeated
        assert chain.sent(CMD_VEL) == []


async def test_an_intent_of_a_tick_whose_state_is_still_on_its_way_waits_for_it() -> None:
    async with Chain() as chain:
        chain.send(BODY, body())
        chain.send(STATE, state(9))
        chain.sent(CMD_VEL)
        chain.send(INTENT, intent(10))
        assert chain.sent(CMD_VEL) == []
        chain.send(STATE, state(10))
        assert [(c.tick, c.basis) for c in chain.sent(CMD_VEL)] == [(10, 10)]


async def test_a_silent_decision_is_given_up_after_100_ms() -> None:
    async with Chain() as chain:
        chain.send(BODY, body())
        await chain.go(30, v=0.2)
        speeds = await chain.go(20)
    assert speeds[:6] == pytest.approx([0.2, 0.2, 0.2, 0.2, 0.2, 0.18])
    assert speeds[13:] == pytest.approx([0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], abs=1e-9)


async def test_an_intent_of_an_earlier_start_of_the_driver_is_not_obeyed() -> None:
    async with Chain() as chain:
        chain.send(BODY, body())
        chain.send(STATE, state(1))
        for tick in range(2, 6):
            chain.send(INTENT, intent(tick, boot=8))
            chain.send(STATE, state(tick))
        assert {command.linear_x for command in chain.sent(CMD_VEL)} == {0.0}


async def test_without_body_or_state_it_says_nothing() -> None:
    async with Chain() as chain:
        chain.send(STATE, state(1))
        chain.send(INTENT, intent(1))
        assert chain.sent(CMD_VEL) == []
        chain.send(BODY, body())
        await chain.clock.advance(260 * MS)  # the driver has stopped
        chain.send(INTENT, intent(1, basis=1))
        assert chain.sent(CMD_VEL) == []


def tick_in_any_order() -> list[tuple[tuple[Topic[Message], Message], ...]]:
    """The messages of a tick in which all has changed, in all the orders in which they may come."""
    news = ((STATE, state(12)), (INTENT, intent(12)), (SAFETY, verdict(12, forward=0.01)))
    return list(itertools.permutations(news))  # type: ignore[arg-type]


@pytest.mark.parametrize("order", tick_in_any_order())
async def test_no_command_depends_on_which_message_of_a_tick_was_quicker(
    order: tuple[tuple[Topic[Message], Message], ...],
) -> None:
    async with Chain() as chain:
        chain.send(BODY, body())
        for tick in (9, 10, 11):
            chain.send(STATE, state(tick))
            chain.send(INTENT, intent(tick, 0.05))
            chain.send(SAFETY, verdict(tick, forward=0.05))
        for topic, message in order:
            chain.send(topic, message)
        last = chain.sent(CMD_VEL)[-1]
        assert (last.tick, last.basis) == (12, 12)
        assert last.linear_x == pytest.approx(0.05)
        chain.send(STATE, state(13))  # the verdict of tick 12 holds from here
        assert chain.sent(CMD_VEL)[-1].linear_x == pytest.approx(0.03)


def test_caps_hold_from_the_tick_after_their_verdict_for_150_ms() -> None:
    verdicts = PreviousTick[SafetyState]()
    assert caps_at(verdicts, state(9)) == NO_CAPS
    verdicts.receive(verdict(10, 0.1))
    verdicts.receive(verdict(12, 0.3))
    verdicts.receive(verdict(12, 0.2))  # with the scan of that tick
    found = [caps_at(verdicts, state(tick)).forward for tick in (10, 11, 12, 13, 19, 20)]
    assert found == [None, 0.1, 0.1, 0.2, 0.2, None]
    assert caps_at(verdicts, state(13, boot=8)) == NO_CAPS
    verdicts.receive(verdict(1, 0.05, boot=8))
    assert caps_at(verdicts, state(2, boot=8)).forward == 0.05


FORWARD = Twist(linear_x=0.1)  # as typed by a person: no boot, no tick


async def test_teleop_is_deaf_for_half_a_second_and_then_drives() -> None:
    async with Chain() as chain:
        chain.send(BODY, body())
        speeds = await chain.go(40, teleop=FORWARD)
    assert set(speeds[:26]) == {0.0}  # the first message came with the second tick
    assert speeds[26:30] == pytest.approx([0.02, 0.04, 0.06, 0.08])


async def test_teleop_that_ends_holds_zero_and_does_not_hand_back_by_itself() -> None:
    async with Chain() as chain:
        chain.send(BODY, body())
        await chain.go(40, v=0.2, teleop=FORWARD)
        after = await chain.go(60, v=0.2)
        assert after[:10] == pytest.approx([0.1] * 10)  # 200 ms after its last message
        assert after[10:16] == pytest.approx([0.08, 0.06, 0.04, 0.02, 0.0, 0.0])
        assert set(after[15:]) == {0.0}
        handed_back = GateStatus(mode="enabled", commander="control", enables=2)
        back = await chain.go(4, v=0.2, gate=handed_back)
        assert back == pytest.approx([0.02, 0.04, 0.06, 0.08])


class Stick:
    """An operator's joystick, on a clock of its own."""

    def __init__(self) -> None:
        self.now_ms = 1000
        self.teleop = Teleop(lambda: self.now_ms * MS)
        self.teleop.velocity(state(0), echo_wanted=False)  # the hand-over was long ago

    def push(self, every_ms: int, times: int, twist: Twist = FORWARD) -> None:
        for _ in range(times):
            self.now_ms += every_ms
            self.teleop.receive(twist)

    def moves(self, tick: int = 100, *, echo_wanted: bool = False) -> bool:
        return self.teleop.velocity(state(tick), echo_wanted) is not None


def test_a_stream_is_believed_from_half_a_second_on() -> None:
    stick = Stick()
    assert not stick.moves()
    stick.push(50, 10)  # 450 ms after the first
    assert not stick.moves()
    stick.push(50, 1)
    assert stick.moves()


def test_whoever_echoes_the_newest_tick_is_believed_at_once() -> None:
    stick = Stick()
    stick.push(50, 1, Twist(linear_x=0.1, boot=BOOT, tick=100))
    assert stick.moves()
    assert stick.moves(echo_wanted=True)
    stick.push(3000, 100, Twist(linear_x=0.1, boot=BOOT, tick=80))  # stored by a network
    assert not stick.moves()


@pytest.mark.parametrize(("gap_ms", "believed"), [(200, True), (201, False)])
def test_after_a_gap_of_more_than_200_ms_it_is_deaf_again(gap_ms: int, believed: bool) -> None:
    stick = Stick()
    stick.push(50, 11)
    stick.push(gap_ms, 1)
    assert stick.moves() is believed
    stick.push(0, 100)  # the network delivers all stored messages at once
    assert stick.moves() is believed
    stick.push(50, 10)
    assert stick.moves()


@pytest.mark.parametrize(("age_ms", "moves"), [(200, True), (201, False)])
def test_a_stream_ends_200_ms_after_its_last_message(age_ms: int, moves: bool) -> None:
    stick = Stick()
    stick.push(50, 11)
    stick.now_ms += age_ms
    assert stick.moves() is moves


@pytest.mark.parametrize(
    ("tick", "boot", "on_a_real_body", "in_simulation"),
    [
        (100, BOOT, True, True),
        (90, BOOT, True, True),  # 200 ms ago
        (89, BOOT, False, False),
        (110, BOOT, True, True),  # the operator's tick may arrive before ours
        (111, BOOT, False, False),
        (100, 8, False, False),
        (0, 0, False, True),  # no echo at all
    ],
)
def test_a_real_body_wants_the_newest_tick_echoed(
    tick: int, boot: int, on_a_real_body: bool, in_simulation: bool
) -> None:
    stick = Stick()
    stick.push(50, 11, Twist(linear_x=0.1, boot=boot, tick=tick))
    assert stick.moves(echo_wanted=True) is on_a_real_body
    assert stick.moves(echo_wanted=False) is in_simulation


@pytest.mark.parametrize("real", [True, False])
async def test_the_kind_of_link_decides_whether_the_echo_is_wanted(real: bool) -> None:
    async with Chain() as chain:
        chain.send(BODY, body(real=real))
        speeds = await chain.go(40, teleop=FORWARD)
    assert (speeds[-1] == 0.0) is real


REST = Twist(linear_x=0.0)


def by(source: str, twist: Twist = FORWARD) -> Twist:
    """A message of an operator who echoes the newest tick."""
    return replace(twist, source=source, boot=BOOT, tick=100)


def speed_of(stick: Stick) -> float | None:
    velocity = stick.teleop.velocity(state(100), echo_wanted=True)
    return velocity.linear_x if velocity else None


def test_of_two_operators_the_first_one_steers_until_it_rests_or_is_silent() -> None:
    stick, back = Stick(), Twist(linear_x=-0.2)
    stick.push(10, 1, by("page-1"))
    stick.push(10, 1, by("page-2", back))
    stick.push(10, 1, by("teleop", REST))  # an idle station
    assert speed_of(stick) == 0.1
    stick.push(10, 1, by("page-1", REST))
    assert speed_of(stick) == -0.2
    stick.push(10, 1, by("page-1"))
    assert speed_of(stick) == -0.2
    for _ in range(10):  # the second one is cut off
        stick.push(20, 1, by("page-1"))
    assert speed_of(stick) == 0.1


def test_when_all_operators_rest_the_robot_is_still_theirs() -> None:
    stick = Stick()
    stick.push(10, 1, by("page-1"))
    assert speed_of(stick) == 0.1
    for source in ("teleop", "page-1"):
        stick.push(10, 1, by(source, REST))
    assert speed_of(stick) == 0.0


def test_joints_are_moved_by_one_operator_at_a_time_as_well() -> None:
    stream = OperatorStream[JointSpeeds](lambda: 1000 * MS)
    for source, speed in (("page-1", 0.5), ("page-2", -0.5), ("teleop", 0.0)):
        speeds = JointSpeeds(name=("pan",), velocity=(speed,), source=source, boot=BOOT, tick=100)
        stream.receive(speeds)
        found = stream.live(state(100), echo_wanted=True)
        assert found is not None
        assert found.velocity == (0.5,)


def test_a_stream_that_is_not_believed_keeps_no_operator_out() -> None:
    stick = Stick()
    stored = replace(by("a network"), tick=50)
    stick.push(10, 1, stored)
    stick.push(10, 1, by("page-1", Twist(linear_x=0.2)))
    stick.push(10, 1, stored)
    assert speed_of(stick) == 0.2


def test_of_a_flood_of_sources_only_the_newest_16_are_kept() -> None:
    stick = Stick()
    for number in range(1000):
        stick.push(0, 1, by(f"flood {number}"))
    assert list(stick.teleop.streams) == [f"flood {number}" for number in range(984, 1000)]


def test_what_the_operator_asks_for_is_passed_on_whole() -> None:
    stick = Stick()
    stick.push(50, 11, Twist(linear_x=0.1, linear_y=-0.2, angular_z=0.3))
    found = stick.teleop.velocity(state(1), echo_wanted=False)
    assert found == Velocity(linear_x=0.1, linear_y=-0.2, angular_z=0.3)


async def test_a_body_that_wants_25_commands_a_second_gets_every_second_tick() -> None:
    slow = replace(WAFFLE, control=ControlGains(rate_hz=25.0))
    async with Chain() as chain:
        chain.send(BODY, body(slow))
        for tick in range(1, 9):
            chain.send(STATE, state(tick))
        assert [c.tick for c in chain.sent(CMD_VEL)] == [2, 4, 6, 8]
        chain.send(STATE, state(9))
        chain.send(INTENT, intent(9))  # a new intent is not delayed
        assert [(c.tick, c.basis) for c in chain.sent(CMD_VEL)] == [(9, 9)]


async def test_a_body_with_a_control_topic_of_its_own_is_commanded_there() -> None:
    async with Chain() as chain:
        chain.send(BODY, body(replace(WAFFLE, control_topic="robot/base/cmd")))
        chain.send(STATE, state(1))
        assert [key for key, _ in chain.network.sent] == ["robot/base/cmd"]
