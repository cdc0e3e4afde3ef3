"""Automatic enabling of the gate after a stop, where a deployment allows it."""

from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.gate import gate
from tests.unit.gate.rig import BLIND, Rig, enabled, idle


def test_auto_resume_opens_it_after_half_a_second_of_health() -> None:
    rig = Rig(auto_resume=True)
    rig.live(1)
    assert rig.until("enabled", lambda: rig.live(1)) == 25
    assert (rig.state.commander, rig.state.enables, rig.state.causes) == ("control", 1, ())


def test_auto_resume_waits_until_the_body_is_at_rest() -> None:
    rig = Rig(auto_resume=True)
    rig.live(10)
    rig.tick(measured=Velocity(angular_z=1.0))
    assert rig.until("enabled", lambda: rig.live(1)) == 25


def test_auto_resume_waits_until_the_brain_is_well() -> None:
    rig = Rig(auto_resume=True)
    for _ in range(100):
        rig.tick()
        rig.safety()
    assert (rig.mode, rig.codes) == ("latched", ["boot", "silence"])
    rig.send()
    assert rig.until("enabled", lambda: rig.live(1)) == 25


def test_auto_resume_opens_it_again_for_what_clears_by_itself() -> None:
    rig = enabled()
    rig.config = gate.GateConfig(limits=rig.config.limits, auto_resume=True)
    rig.live(110, 0.2)
    assert rig.until("stopping", rig.tick) == 6
    assert rig.until("idle", lambda: rig.live(1)) == 15
    assert rig.until("enabled", lambda: rig.live(1)) == 11
    assert rig.state.enables == 2


def test_auto_resume_leaves_2200_ms_from_one_start_to_the_next() -> None:
    rig = Rig(auto_resume=True)
    rig.live(1)
    rig.until("enabled", lambda: rig.live(1))
    first = rig.state.tick
    rig.until("stopping", rig.tick)
    rig.until("enabled", lambda: rig.live(1))
    assert rig.state.tick - first == 110


def test_health_is_the_brains_also_while_a_script_is_being_stopped() -> None:
    rig = enabled("alice")
    rig.config = gate.GateConfig(limits=rig.config.limits, auto_resume=True)

    def without_the_brain() -> None:
        rig.tick()
        rig.safety()

    assert rig.until("stopping", without_the_brain) == 6
    assert rig.until("idle", without_the_brain) == 15
    for _ in range(90):
        without_the_brain()
    rig.send()
    assert rig.until("enabled", lambda: rig.live(1)) == 25
    assert rig.state.commander == "control"


def test_a_stop_by_safety_between_two_ticks_ends_health_too() -> None:
    rig = enabled()
    rig.config = gate.GateConfig(limits=rig.config.limits, auto_resume=True)
    rig.live(110)
    rig.safety(BLIND, verdict="stop")
    rig.safety()
    assert rig.mode == "stopping"
    assert rig.until("idle", lambda: rig.live(1)) == 15
    assert rig.until("enabled", lambda: rig.live(1)) == 10


def test_auto_resume_never_releases_what_latches() -> None:
    rig = enabled()
    rig.config = gate.GateConfig(limits=rig.config.limits, auto_resume=True)
    rig.feed(gate.Estop("alice"))
    rig.live(200)
    assert (rig.mode, rig.codes) == ("latched", ["estop"])


def test_after_an_estop_a_person_enables_even_where_it_resumes_by_itself() -> None:
    rig = enabled()
    rig.config = gate.GateConfig(limits=rig.config.limits, auto_resume=True)
    rig.feed(gate.Estop("alice"))
    rig.live(30)
    assert rig.feed(gate.Release(1)).ok
    rig.live(200)
    assert rig.mode == "idle"
    assert rig.state.by_hand is True
    assert rig.feed(gate.Enable("control")).ok
    assert rig.state.by_hand is False
    rig.live(110)
    rig.until("idle", rig.tick)
    rig.live(1)
    assert rig.until("enabled", lambda: rig.live(1)) == 25


def test_a_release_from_boot_leaves_auto_resume_in_force() -> None:
    rig = idle(auto_resume=True)
    rig.live(1)
    assert rig.mode == "enabled"
