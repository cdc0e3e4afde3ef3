"""The commander of /cmd_vel: a pure state machine, here with literal times."""

import math

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Cause, Velocity
from gigabrain_schemas.body import GateStatus
from gigabrain_zenoh.gateway.commander import (
    Ask,
    Config,
    Memory,
    Now,
    Refuse,
    Send,
    Wanted,
    answer,
    arrive,
    forget,
    observe,
    offsets_s,
    silent,
)
from gigabrain_zenoh.geometry.limits import limits_of
from gigabrain_zenoh.testing import samples

CONFIG, LIMITS = Config(name="ros2"), limits_of(samples.WAFFLE)
UNIX_NS = 1_795_580_000_000_000_000
IDLE = GateStatus(mode="idle")
OURS = GateStatus(mode="enabled", commander="ros2", enables=3)
AHEAD = Velocity(linear_x=0.2)


class Machine:
    """A commander on a clock of milliseconds, and the gate as the robot's states show it."""

    def __init__(self, config=CONFIG, limits=LIMITS):
        self.config, self.limits = config, limits
        self.ms, self.memory, self.gate, self.boot = 0, Memory(), IDLE, samples.BOOT
        self.set_ms = self.suspended_ms = 0  # by which the clock was set, and the host slept

    @property
    def now(self):
        passed = self.ms * 1_000_000
        boot = passed + self.suspended_ms * 1_000_000
        unix = UNIX_NS + boot + self.set_ms * 1_000_000
        return Now(passed, unix, unix, boot)

    def run(self, step, *about):
        self.memory, actions = step(self.config, *about, self.now)
        return list(actions)

    def command(self, x=0.2, *, y=0.0, turn=0.0, sender=b"a", frame="", age_ms=None, late_ms=None,
                number=None):  # fmt: skip
        now = self.now.unix_ns
        stamp = 0 if age_ms is None else now - age_ms * 1_000_000
        sent = None if late_ms is None else now - late_ms * 1_000_000
        wanted = Wanted((x, y, 0.0), (0.0, 0.0, turn), sender, frame, stamp, sent, number)
        return self.run(arrive, self.limits, self.memory, wanted)

    def state(self, gate=None, boot=None):
        self.gate, self.boot = gate or self.gate, boot or self.boot
        return self.run(observe, self.memory, samples.state(gate=self.gate, boot=self.boot))

    def grants(self):
        self.gate = replace(OURS, enables=self.gate.enables + 1)
        return self.run(answer, self.memory, self.gate, "")

    def drives(self, period_ms=50, times=5):
        """Send commands until the period is known; the last one has just come."""
        self.state()
        assert self.command() == [Ask(False)]
        self.grants()
        for _ in range(times):
            self.ms += period_ms
            self.state()
            assert self.command() == [Send(AHEAD)]

    def sends(self, until_ms, every_ms=20):
        """Return when which speed is sent, with a state each 20 ms; times count from here."""
        start, sent = self.ms, []
        while self.ms - start < until_ms:
            self.ms += every_ms
            sent += [(self.ms - start, one.velocity.linear_x) for one in self.state()]
        return sent


def test_the_first_command_that_moves_asks_for_the_body_without_taking_it():
    machine = Machine()
    machine.state()
    assert machine.command(0.0) == []
    assert machine.command(0.2) == [Ask(False)]
    assert machine.command(0.2) == []  # the answer is on its way
    assert machine.grants() == [Send(AHEAD)]
    machine.ms = 20
    assert machine.command(0.1) == [Send(Velocity(linear_x=0.1))]


def test_it_takes_the_body_only_where_the_settings_say_so():
    machine = Machine(replace(CONFIG, take=True))
    machine.state(samples.DRIVING)
    assert machine.command() == [Ask(True)]


def test_while_another_commander_drives_commands_are_refused_and_say_who():
    machine = Machine()
    machine.state(samples.DRIVING)
    assert machine.command() == [Refuse("commander")]
    assert machine.memory.refusal.startswith("control drives")
    machine.ms = 520  # it has gone
    machine.state(IDLE)
    assert machine.command() == [Ask(False)]


def test_without_a_state_of_the_robot_commands_are_refused():
    machine = Machine()
    assert machine.command() == [Refuse("no_robot")]


def test_a_robot_that_was_silent_is_driven_again_only_after_a_pause():
    machine = Machine()
    machine.drives()
    for _ in range(20):
        machine.ms += 50
        machine.memory, actions = silent(machine.memory, machine.now)
        assert actions == (Refuse("no_robot"),)
    machine.ms += 50
    machine.state(replace(IDLE, enables=9))
    assert machine.command() == [Refuse("commander")]
    assert "the robot was silent" in machine.memory.refusal
    machine.command(0.0)
    assert machine.command() == [Ask(False)]


def test_a_refusal_is_named_as_long_as_commands_come():
    machine = Machine()
    machine.state()
    for _ in range(20):
        machine.ms += 50
        assert machine.command(age_ms=3000) == [Refuse("stale")]
        machine.state()
        assert "3.00 s old" in machine.memory.refusal
    machine.sends(520)
    assert machine.memory.refusal == ""


def test_a_refusal_of_the_gate_is_kept_and_asked_again_after_half_a_second():
    machine = Machine()
    machine.state()
    assert machine.command() == [Ask(False)]
    assert machine.run(answer, machine.memory, None, "still stopping") == []
    assert machine.memory.refusal == "still stopping"
    machine.ms = 480
    assert machine.command() == []
    machine.ms = 500
    assert machine.command() == [Ask(False)]


def test_a_killed_publisher_of_50_ms_is_repeated_for_50_ms_and_braked_within_120_ms_of_that():
    machine = Machine()
    machine.drives(period_ms=50)
    # the gate bears the silence from 60 to 120 ms; zero then comes before it stops by itself
    assert machine.sends(600) == [
        (20, 0.2), (40, 0.2),
        *((ms, 0.0) for ms in range(120, 500, 20)),
    ]  # fmt: skip
    assert not machine.memory.holds


@pytest.mark.parametrize(
    ("period_ms", "last_repeat", "first_zero"),
    [(20, 20, 100), (100, 100, 180), (200, 200, 280), (400, 200, 280)],
)
def test_a_command_counts_for_one_period_and_at_most_200_ms(period_ms, last_repeat, first_zero):
    machine = Machine()
    machine.drives(period_ms=period_ms)
    sent = machine.sends(600)
    assert max(ms for ms, speed in sent if speed) == last_repeat
    assert min(ms for ms, speed in sent if not speed) == first_zero
    assert first_zero - last_repeat < 100  # the gate stops by itself after 100 ms of silence


def test_the_timeout_of_the_settings_shortens_that():
    machine = Machine(replace(CONFIG, timeout_ns=60_000_000))
    machine.drives(period_ms=100)
    assert max(ms for ms, speed in machine.sends(600) if speed) == 60


def test_the_median_interval_bears_one_late_command():
    machine = Machine()
    machine.drives(period_ms=40, times=8)
    machine.ms += 160
    machine.state()
    machine.command()
    assert max(ms for ms, speed in machine.sends(300) if speed) == 40


def test_a_single_command_counts_for_the_longest_period():
    machine = Machine()
    machine.state()
    machine.command()
    machine.grants()
    assert max(ms for ms, speed in machine.sends(600) if speed) == 200


def test_the_body_is_given_back_half_a_second_after_the_last_command():
    machine = Machine()
    machine.drives(period_ms=50)
    assert max(ms for ms, _ in machine.sends(1000)) == 480
    assert machine.state() == []
    machine.state(replace(machine.gate, mode="idle", commander=""))
    assert machine.command() == [Ask(False)]


def test_zero_keeps_the_body_and_does_not_ask_for_it():
    machine = Machine()
    machine.drives(period_ms=50)
    for _ in range(40):
        machine.ms += 50
        machine.state()
        assert machine.command(0.0) == [Send(Velocity())]
    assert machine.memory.holds


def test_a_command_after_giving_back_goes_on_while_the_gate_is_still_open():
    machine = Machine()
    machine.drives(period_ms=50)
    machine.sends(520)
    assert machine.command(0.0) == []
    assert machine.command(0.2) == [Send(AHEAD)]


PRESSED = Cause(code="estop", text="e-stop pressed", remedy="look")
LATCHED = GateStatus(mode="latched", causes=(PRESSED,), enables=4, estop_generation=1)


@pytest.mark.parametrize(
    ("gate", "words"),
    [
        (GateStatus(mode="enabled", commander="ann", enables=9), "ann has taken the body"),
        (GateStatus(mode="stopping", commander="ros2", enables=4), "the gate has stopped"),
        (LATCHED, "the gate has stopped: e-stop pressed"),
    ],
)
def test_a_lost_body_is_asked_for_only_after_the_sender_has_sent_zero(gate, words):
    machine = Machine()
    machine.drives()
    assert machine.state(gate) == []
    assert machine.memory.refusal.startswith(words)
    for _ in range(20):  # it goes on to send, also when the body is free again
        machine.ms += 50
        machine.state(replace(IDLE, enables=9))
        assert machine.command() == [Refuse("commander")]
    assert machine.command(0.0) == []
    assert machine.command() == [Ask(False)]


def test_a_lost_body_is_asked_for_after_a_pause_of_half_a_second():
    machine = Machine()
    machine.drives()
    machine.state(LATCHED)
    machine.state(replace(IDLE, enables=4))
    machine.sends(480)
    assert machine.command() == [Refuse("commander")]
    machine.sends(500)
    assert machine.command() == [Ask(False)]


@pytest.mark.parametrize("first", ["state", "command"])
def test_a_commander_that_was_frozen_counts_its_freeze_as_no_pause_of_the_sender(first):
    machine = Machine()
    machine.drives()
    machine.ms += 1500
    machine.gate = replace(IDLE, enables=machine.gate.enables)
    if first == "command":  # the gate refuses what it sends
        machine.command()
    for _ in range(20):
        machine.state()
        assert machine.command() == [Refuse("commander")]
        machine.ms += 50
    assert "the gate has stopped" in machine.memory.refusal
    machine.sends(500)
    assert machine.command() == [Ask(False)]


def test_a_stream_that_was_there_before_a_release_does_not_move_the_body():
    machine = Machine()
    machine.state(LATCHED)
    machine.ms = 20
    assert machine.command() == [Refuse("commander")]
    machine.ms = 40
    machine.state()
    machine.ms = 70
    machine.state(IDLE)
    assert machine.command() == [Refuse("commander")]
    assert "send zero" in machine.memory.refusal


def test_states_from_before_the_grant_do_not_end_the_lease():
    machine = Machine()
    machine.state(replace(IDLE, enables=3))
    machine.command()
    machine.run(answer, machine.memory, replace(OURS, enables=4), "")
    machine.ms = 20
    assert machine.state(replace(IDLE, enables=3)) == [Send(AHEAD)]
    assert machine.memory.holds
    assert machine.state(replace(LATCHED, enables=3)) == [Send(AHEAD)]


def test_a_restarted_driver_has_granted_nothing():
    machine = Machine()
    machine.drives()
    assert machine.state(GateStatus(mode="latched", enables=0), boot=8) == []
    assert not machine.memory.holds


def test_a_grant_that_comes_after_the_stream_has_ended_moves_nothing():
    machine = Machine()
    machine.state()
    machine.command()
    machine.ms = 300
    assert machine.run(answer, machine.memory, OURS, "") == [Send(Velocity())]
    machine = Machine()
    machine.state()
    machine.command()
    machine.ms = 600
    assert machine.run(answer, machine.memory, OURS, "") == []
    assert not machine.memory.holds


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_nan_and_infinity_are_refused_and_brake(value):
    machine = Machine()
    machine.drives()
    assert machine.command(value) == [Refuse("not_finite"), Send(Velocity())]
    machine.ms += 20
    assert machine.state() == [Send(Velocity())]
    machine = Machine()
    machine.state()
    assert machine.command(0.2, turn=value) == [Refuse("not_finite")]


@pytest.mark.parametrize(
    ("age_ms", "code"), [(210, "stale"), (5000, "stale"), (-110, "future"), (-9000, "future")]
)
def test_stale_and_future_stamps_are_refused(age_ms, code):
    machine = Machine()
    machine.drives()
    assert machine.command(age_ms=age_ms) == [Refuse(code)]
    assert "clocks" in machine.memory.refusal


def test_stamps_within_bounds_are_obeyed_and_shorten_the_repeats():
    machine = Machine()
    machine.drives(period_ms=100)
    machine.ms += 100
    machine.state()
    assert machine.command(age_ms=-90) == [Send(AHEAD)]
    machine.ms += 100
    machine.state()
    assert machine.command(age_ms=60) == [Send(AHEAD)]
    assert max(ms for ms, speed in machine.sends(300) if speed) == 40


def test_what_a_network_hands_over_after_a_freeze_is_refused():
    machine = Machine()
    machine.drives()
    for _ in range(10):  # a clock that is 1 s behind
        machine.ms += 50
        machine.state()
        machine.command(late_ms=1000)
    machine.ms += 3000
    machine.state(IDLE)
    machine.gate = replace(IDLE, enables=1)
    machine.state()
    for late_ms in (4000, 2000, 1210):
        assert machine.command(late_ms=late_ms) == [Refuse("late")]
    assert machine.command(late_ms=1190) == [Ask(False)]


@pytest.mark.parametrize("step_ms", [-5000, -300, 300, 5000])
@pytest.mark.parametrize("own", [False, True])
def test_a_clock_that_is_set_while_its_host_is_driven_makes_no_sender_late(step_ms, own):
    machine = Machine()
    machine.drives()
    for turn in range(40):
        machine.ms += 50
        machine.set_ms = 0 if turn < 10 else step_ms
        behind_ms = 0 if own else machine.set_ms  # the sender runs on this host, or another
        machine.state()
        assert machine.command(late_ms=2 + behind_ms) == [Send(AHEAD)]
    assert offsets_s(machine.memory, machine.now) == [(2 + behind_ms) / 1000]
    machine.ms += 300  # held back by the network
    assert machine.command(late_ms=303 + behind_ms) == [Refuse("late")]


def test_what_is_handed_over_after_a_suspend_of_this_host_is_refused():
    machine = Machine()
    machine.drives()
    machine.ms += 50
    assert machine.command(late_ms=2) == [Send(AHEAD)]
    machine.suspended_ms = 3000
    assert machine.command(late_ms=2950) == [Refuse("late")]


@pytest.mark.parametrize("back_ms", [300, 5000, 7_200_000])
def test_a_sender_whose_clock_is_set_back_while_it_drives_is_obeyed(back_ms):
    machine = Machine()
    machine.drives(period_ms=100)
    for turn in range(40):
        machine.ms += 100
        machine.state()
        behind_ms = 0 if turn < 10 else back_ms
        assert machine.command(late_ms=2 + behind_ms) == [Send(AHEAD)]
    assert max(ms for ms, speed in machine.sends(300) if speed) == 100
    assert machine.command(late_ms=303 + back_ms) == [Refuse("late")]


def test_what_a_network_holds_back_while_its_senders_clock_is_set_back_is_refused():
    machine = Machine()
    machine.drives()
    machine.ms += 50
    assert machine.command(late_ms=2) == [Send(AHEAD)]
    machine.ms += 1050  # sent after 50 ms by a clock that is 5 s behind since
    machine.state(replace(IDLE, enables=9))
    for late_ms in (1002, 952, 252):
        assert machine.command(late_ms=late_ms + 5000) == [Refuse("late")]
    assert "its sender's clock was set back" in machine.memory.refusal


def test_what_comes_by_another_way_after_newer_messages_is_refused():
    machine = Machine()
    machine.drives()
    for number in range(40):
        machine.ms += 50
        machine.state()
        assert machine.command(late_ms=2, number=number) == [Send(AHEAD)]
    for number in (4, 5, 6):
        assert machine.command(late_ms=1752 - 50 * number, number=number) == [Refuse("late")]
    machine.ms += 50
    assert machine.command(late_ms=2, number=40) == [Send(AHEAD)]
    machine.ms += 50  # a clock that was set back does not change the numbers
    assert machine.command(late_ms=1752, number=41) == [Send(AHEAD)]


def test_the_messages_of_unknown_senders_have_no_order():
    machine = Machine()
    machine.drives()
    machine.command(sender=b"", late_ms=2)
    machine.ms += 50
    assert machine.command(sender=b"", late_ms=5002) == [Refuse("late")]


def test_a_sender_whose_messages_have_no_time_is_obeyed():
    machine = Machine()
    machine.drives()
    for _ in range(40):
        machine.ms += 50
        machine.state()
        timeless = Wanted((0.2, 0.0, 0.0), (0.0, 0.0, 0.0), b"a", sent_ns=0)
        assert machine.run(arrive, LIMITS, machine.memory, timeless) == [Send(AHEAD)]


def test_frames_that_are_not_the_body_are_refused():
    machine = Machine()
    machine.drives()
    assert machine.command(frame="odom") == [Refuse("frame")]
    assert machine.command(frame="robot1/base_link") == [Send(AHEAD)]
    assert machine.command(frame="base_footprint") == [Send(AHEAD)]


def test_a_body_that_cannot_move_sideways_does_not_and_says_so():
    machine = Machine()
    machine.drives()
    assert machine.command(0.2, y=0.3) == [Send(AHEAD), Refuse("sideways")]
    machine = Machine()
    machine.state()
    assert machine.command(0.0, y=0.3) == [Refuse("sideways")]
    omni = replace(samples.WAFFLE, drive_type="omni", max_lateral_speed=0.2)
    machine = Machine(limits=limits_of(omni))
    machine.state()
    assert machine.command(0.0, y=0.3) == [Ask(False)]
    assert machine.grants() == [Send(Velocity(linear_y=0.2))]


def test_speeds_are_bounded_by_those_of_the_body():
    machine = Machine()
    machine.state()
    machine.command(9.0, turn=-9.0)
    (sent,) = machine.grants()
    assert (sent.velocity.linear_x, sent.velocity.angular_z) == (0.26, -1.82)


def test_each_sender_has_its_own_period():
    machine = Machine()
    machine.drives(period_ms=200)
    for _ in range(5):
        machine.ms += 40
        machine.state()
        machine.command(sender=b"b")
    assert max(ms for ms, speed in machine.sends(600) if speed) == 40


def test_the_senders_that_are_remembered_are_few():
    machine = Machine()
    machine.drives()
    for number in range(50):
        machine.command(sender=bytes([number]))
    assert len(machine.memory.senders) == 8


def test_an_estop_from_ros_ends_its_own_commands_first():
    machine = Machine()
    machine.drives()
    machine.memory = forget(machine.memory, "an e-stop was pressed")
    machine.ms += 20
    assert machine.state() == []
    assert machine.command() == [Refuse("commander")]


def test_the_clock_of_a_sender_is_known_by_its_fastest_command_while_it_commands():
    machine = Machine()
    for late_ms in (-4990, -5000, -4980):
        machine.command(late_ms=late_ms)
    machine.command(sender=b"b")
    assert offsets_s(machine.memory, machine.now) == [-5.0]
    machine.ms += 500
    assert offsets_s(machine.memory, machine.now) == []
