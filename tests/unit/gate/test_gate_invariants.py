"""Invariants of the gate, tested by hypothesis with events in any order.

The test keeps its own record, from the events alone, and compares the gate with it.
"""

import math
from typing import Literal

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule
from msgspec.structs import replace

from gigabrain_schemas.base import Cause, Velocity
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SafetyState, SpeedCaps
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.limits import NO_CAPS, ZERO, Limits, clamp
from tests.unit.gate.rig import BLIND, BOOT, CRASHED, HOT, LIMITS, LOST, ZONE

MS = 1_000_000
GAIN = (0.02, 0.02, 0.06)  # maximum gain of speed per tick, by axis, from LIMITS
LOSS = (0.04, 0.04, 0.06)
MAX_SPEEDS = (0.26, 0.2, 1.8)
RIM, HALF_TRACK = 0.266, 0.1435  # [m/s], [m], of a base with slower wheels
ROUNDING = 1e-9
MOVES = {
    ("latched", "idle"),
    ("latched", "enabled"),
    ("idle", "latched"),
    ("idle", "enabled"),
    ("enabled", "latched"),
    ("enabled", "stopping"),
    ("stopping", "latched"),
    ("stopping", "idle"),
}

sources = st.sampled_from(["control", "control", "alice", ""])
boots = st.sampled_from([BOOT] * 6 + [BOOT - 1, 0])
speed = st.sampled_from([0.0, 0.1, -0.1, 0.26, -0.26, 1e9, -1e9, 1e-200, -1e-200])
hostile = st.one_of(speed, speed, speed, st.sampled_from([math.nan, math.inf, -math.inf]))
cap = st.sampled_from([None, 0.0, 0.05, 1.0])
caps = st.just(NO_CAPS) | st.builds(
    SpeedCaps, forward=cap, backward=cap, left=cap, right=cap, rotation=cap
)
causes = st.sampled_from([(), (), (ZONE,), (BLIND,), (HOT,), (ZONE, HOT)])
faults = st.sampled_from([(), (), (), (LOST,), (CRASHED,)])
ages = st.sampled_from([0, 0, 0, 0, 1, 7, 8, -1])  # [ticks]
looks = st.sampled_from([0, 0, 0, 12, 13, -1, None])  # [ticks] since the scan


def axes(of: Velocity | CmdVel) -> tuple[float, float, float]:
    return of.linear_x, of.linear_y, of.angular_z


def latching(causes: tuple[Cause, ...]) -> set[str]:
    return {cause.code for cause in causes if cause.latching}


class GateMachine(RuleBasedStateMachine):
    """Random events for a gate. Every event goes through `feed`, which checks all rules."""

    @initialize(auto_resume=st.booleans(), slow_wheels=st.booleans())
    def boot(self, auto_resume: bool, slow_wheels: bool) -> None:
        self.limits: Limits = LIMITS
        if slow_wheels:
            self.limits = replace(LIMITS, rim_speed=RIM, half_track=HALF_TRACK)
        self.config = gate.GateConfig(limits=self.limits, auto_resume=auto_resume)
        self.state = gate.GateState(boot=BOOT)
        self.issued_ns = [0]  # by tick
        self.sent = (0.0, 0.0, 0.0)  # velocity sent to the body in the last tick
        self.enabled_tick = 0  # tick in which the current commander was enabled
        self.newest_command: CmdVel | None = None  # its newest good command
        self.newest_command_tick = 0
        self.seq = 0
        self.nan_source = ""  # the newest commander that sent a value that is not finite
        self.newest_safety: SafetyState | None = None
        self.faults: tuple[Cause, ...] = ()
        self.still = 0

    @rule(
        linear=st.sampled_from([0.0, 0.009, 0.01, math.nan]),
        angular=st.sampled_from([0.0, 0.0, 0.049, -0.05]),
        faults=faults,
        wall_ms=st.sampled_from([20, 20, 20, 25, 75, 150, 151]),
    )
    def tick(self, linear: float, angular: float, faults: tuple[Cause, ...], wall_ms: int) -> None:
        self.sent, self.faults = axes(self.state.output), faults
        self.issued_ns.append(self.issued_ns[-1] + wall_ms * MS)
        self.still = self.still + 1 if linear < 0.01 and abs(angular) < 0.05 else 0
        measured = Velocity(linear_x=linear, angular_z=angular)
        self.feed(gate.Tick(measured, self.issued_ns[-1], faults))

    @rule(
        x=hostile,
        y=hostile,
        z=hostile,
        source=sources,
        boot=boots,
        echo=ages,
        look=looks,
        seq=st.sampled_from([1, 1, 1, 7, 0, -3]),
        late_ms=st.sampled_from([0, 0, 5, 150, 151]),
    )
    def command(
        self,
        x: float,
        y: float,
        z: float,
        source: str,
        boot: int,
        echo: int,
        look: int | None,
        seq: int,
        late_ms: int,
    ) -> None:
        self.seq = max(0, self.seq + seq)
        now = self.state.tick
        command = CmdVel(
            linear_x=x,
            linear_y=y,
            angular_z=z,
            source=source,
            seq=self.seq,
            boot=boot,
            tick=max(0, now - echo),
            basis=0 if look is None else max(0, now - look),
        )
        self.send(command, self.issued_ns[-1] + late_ms * MS)

    @rule(
        verdict=st.sampled_from(["ok", "ok", "slow", "stop"]),
        caps=caps,
        causes=causes,
        boot=boots,
        age=ages,
    )
    def safety(
        self,
        verdict: Literal["ok", "slow", "stop"],
        caps: SpeedCaps,
        causes: tuple[Cause, ...],
        boot: int,
        age: int,
    ) -> None:
        tick = max(0, self.state.tick - age)
        state = SafetyState(verdict=verdict, caps=caps, causes=causes, boot=boot, tick=tick)
        newest = self.newest_safety.tick if self.newest_safety else 0
        if boot == BOOT and newest <= tick <= self.state.tick:
            self.newest_safety = state
        self.feed(gate.Safety(state))

    @rule(source=sources, boot=boots, times=st.sampled_from([1, 1, 5]))
    def not_finite(self, source: str, boot: int, times: int) -> None:
        for _ in range(times):
            before = self.state
            assert self.feed(gate.NotFinite(source, boot)).refused == "not_finite"
            counts = source == (before.commander or self.nan_source) != ""
            counts &= boot == BOOT and before.mode != "latched"
            assert (self.state != before) == counts

    @rule(source=sources)
    def estop(self, source: str) -> None:
        generation = self.state.estop_generation
        assert self.feed(gate.Estop(source)).ok
        assert self.state.estop_generation == generation + 1
        assert (self.state.mode, self.state.output) == ("latched", ZERO)

    @rule(wrong=st.sampled_from([0, 0, 0, 1, -1]))
    def release(self, wrong: int) -> None:
        self.feed(gate.Release(self.state.estop_generation + wrong))

    @rule(source=sources, take=st.booleans(), by=st.sampled_from(["", "control", "bob"]))
    def enable(self, source: str, take: bool, by: str) -> None:
        held = self.state.commander not in ("", source)
        granted = self.feed(gate.Enable(source, take, by)).ok
        assert not (granted and held and source == "control") or by == "bob"

    @rule(ticks=st.sampled_from([1, 4, 26]), x=speed, z=speed)
    def all_is_well(self, ticks: int, x: float, z: float) -> None:
        for _ in range(ticks):
            self.tick(0.0, 0.0, (), 20)
            self.safety("ok", NO_CAPS, (), BOOT, 0)
            self.command(x, 0.0, z, self.state.commander or "control", BOOT, 0, 0, 1, 0)

    @rule(source=sources, x=speed, z=speed)
    def a_person_sets_it_going(self, source: str, x: float, z: float) -> None:
        self.all_is_well(26, 0.0, 0.0)
        self.release(0)
        self.enable(source, True, "bob")
        self.all_is_well(8, x, z)

    @rule(first=st.sampled_from([(0.0, 9.0), (9.0, 0.0)]), then_x=speed, then_z=speed)
    def it_goes_flat_out_and_then_another_way(
        self, first: tuple[float, float], then_x: float, then_z: float
    ) -> None:
        self.a_person_sets_it_going("control", *first)
        self.all_is_well(32, *first)
        self.all_is_well(13, then_x, then_z)

    def send(self, command: CmdVel, wall_ns: int) -> None:
        before, newest = self.state, self.newest_command
        outcome = self.feed(gate.VelocityCommand(command, wall_ns))
        assert outcome.ok == (outcome.refused == "")
        if outcome.refused:
            assert self.state.command == before.command
            assert self.state.command_tick == before.command_tick
            return
        assert before.mode == "enabled"
        assert command.source == before.commander != ""
        assert command.boot == BOOT
        assert 0 <= before.tick - command.tick <= 7
        assert wall_ns - self.issued_ns[command.tick] <= 150 * MS
        assert newest is None or command.seq > newest.seq
        assert command.basis or command.source != "control" or axes(command) == (0.0, 0.0, 0.0)
        assert all(math.isfinite(value) for value in axes(command))

    def feed(self, event: gate.Event) -> gate.Outcome:
        before = self.state
        self.state, outcome = gate.step(self.config, before, event)
        assert gate.step(self.config, before, event) == (self.state, outcome)
        assert self.state.safety == self.newest_safety
        self.update_record(before, event, outcome)
        self.check_mode(before, event)
        self.check_causes(before, event)
        self.check_output()
        if self.state.mode == "enabled":
            self.check_may_move()
        return outcome

    def update_record(
        self, before: gate.GateState, event: gate.Event, outcome: gate.Outcome
    ) -> None:
        if self.state.commander != before.commander:
            self.enabled_tick, self.newest_command = self.state.tick, None
        if isinstance(event, gate.VelocityCommand) and not outcome.refused:
            self.newest_command, self.newest_command_tick = event.command, self.state.tick
        if outcome.refused == "not_finite" and self.state != before:
            of = event.command if isinstance(event, gate.VelocityCommand) else event
            assert isinstance(of, gate.NotFinite | CmdVel)
            self.nan_source = of.source
        theirs = before.commander != "" and outcome.refused == "not_finite"
        if isinstance(event, gate.Estop) or (theirs and self.state != before):
            self.sent = (0.0, 0.0, 0.0)  # these two cut the output at once

    def check_mode(self, before: gate.GateState, event: gate.Event) -> None:
        after = self.state
        assert before.mode == after.mode or (before.mode, after.mode) in MOVES
        assert (after.commander != "") == (after.mode in ("enabled", "stopping"))
        assert after.estop_generation >= before.estop_generation
        if before.mode != "latched" or after.mode == "latched":
            return
        assert self.still >= 25
        if isinstance(event, gate.Release):
            assert after.mode == "idle"
            assert event.estop_generation == before.estop_generation
            assert not latching(self.faults)
            assert not self.newest_safety or not latching(self.newest_safety.causes)
        else:
            assert isinstance(event, gate.Tick)
            assert self.config.auto_resume
            assert after.commander == "control"
            assert not latching(before.causes)

    def check_causes(self, before: gate.GateState, event: gate.Event) -> None:
        if before.mode != "latched" or not isinstance(event, gate.Release):
            assert latching(before.causes) <= latching(self.state.causes)
        if isinstance(event, gate.Tick):
            assert latching(self.faults) <= latching(self.state.causes)
        if latching(self.state.causes):
            assert self.state.mode in ("latched", "stopping")
        assert (self.state.causes == ()) or self.state.mode != "enabled"
        assert (self.state.causes != ()) or self.state.mode not in ("latched", "stopping")

    def check_output(self) -> None:
        """Check the limits of speed and its change, and that it falls to zero unless enabled."""
        starting = self.state.tick - self.enabled_tick < 5
        driven = self.state.mode == "enabled" and self.newest_command is not None and not starting
        allowed = self.newest_safety.caps if self.newest_safety else NO_CAPS
        forward = (allowed.forward, allowed.left, allowed.rotation)
        backward = (allowed.backward, allowed.right, allowed.rotation)
        for axis, value in enumerate(axes(self.state.output)):
            sent = self.sent[axis]
            braking = max(0.0, abs(sent) - LOSS[axis])
            bound = forward[axis] if value > 0 else backward[axis]
            assert abs(value) <= MAX_SPEEDS[axis]
            assert value * sent >= 0  # it never goes through zero
            assert abs(value) >= braking - ROUNDING
            assert abs(value) <= (abs(sent) + GAIN[axis] if driven else braking) + ROUNDING
            assert bound is None or abs(value) <= max(bound, braking) + ROUNDING
        self.check_last_clamp()
        assert self.state.output == ZERO or self.state.mode in ("enabled", "stopping")

    def check_last_clamp(self) -> None:
        """Check that a driver's second clamp changes nothing: the body gets the steps above."""
        clamped = clamp(self.state.output, self.limits)
        for value, kept in zip(axes(self.state.output), axes(clamped), strict=True):
            assert abs(value - kept) <= ROUNDING

    def check_may_move(self) -> None:
        now = self.state.tick
        assert not self.faults
        command = self.newest_command
        assert now - (self.newest_command_tick if command else self.enabled_tick) <= 5
        assert not command or not command.basis or now - command.basis <= 12
        assert self.newest_safety
        assert 0 <= now - self.newest_safety.tick <= 7
        assert self.issued_ns[now] - self.issued_ns[self.newest_safety.tick] <= 150 * MS
        assert self.newest_safety.verdict != "stop"
        assert not latching(self.newest_safety.causes)


TestGate = GateMachine.TestCase
TestGate.settings = settings(stateful_step_count=50)
TestGate.pytestmark = pytest.mark.long
