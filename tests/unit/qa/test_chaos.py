"""Damage to bytes by a bad line, and the commands that set it."""

import random

import pytest

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.qa.proxy.chaos import (
    Chaos,
    LinkDamage,
    ProxyCommand,
    WayCounters,
    parse_command,
)


def damaged(
    chaos: Chaos, pieces: list[bytes], seed: int = 0
) -> tuple[bytes, list[float], WayCounters]:
    """Return the received bytes of `pieces`, sent 10 ms apart, with arrival times and counters."""
    damage = LinkDamage(random.Random(seed), WayCounters())
    out = [out for n, piece in enumerate(pieces) for out in damage.damaged(piece, chaos, n / 100)]
    return b"".join(data for _, data in out), [due_s for due_s, _ in out], damage.figures


def test_the_share_of_flipped_bits_is_as_set() -> None:
    pieces = [bytes(1000)] * 1000
    data, _, figures = damaged(Chaos(corrupt=1e-3), pieces)
    assert figures.flipped == sum(byte != 0 for byte in data) == 1024
    assert all(byte.bit_count() <= 1 for byte in data)
    assert damaged(Chaos(corrupt=1e-3), pieces)[0] == data  # the same seed, the same damage
    assert damaged(Chaos(corrupt=1e-3), pieces, seed=1)[0] != data
    assert damaged(Chaos(corrupt=1.0), [bytes(100)])[2].flipped == 100
    assert damaged(Chaos(corrupt=5e-324), pieces)[2].flipped == 0


def test_dropped_pieces_do_not_arrive_and_are_counted() -> None:
    data, _, figures = damaged(Chaos(drop=0.25), [b"0123456789"] * 1000)
    assert len(data) == 10_000 - figures.dropped == 7420
    assert figures.taken == 10_000


def test_garbage_precedes_each_piece() -> None:
    data, _, figures = damaged(Chaos(garbage=1.0), [b"frame"] * 10)
    assert data.count(b"frame") == 10
    assert len(data) == 50 + figures.garbage
    assert 10 <= figures.garbage <= 640


def test_a_split_piece_arrives_in_two_halves() -> None:
    data, times, _ = damaged(Chaos(split=1.0), [b"01234567"])
    assert (data, times) == (b"01234567", [0.0, 0.002])


def test_merged_pieces_arrive_at_the_same_time() -> None:
    _, times, _ = damaged(Chaos(merge_ms=50), [b"a"] * 6)
    assert times == pytest.approx([0.0, 0.05, 0.05, 0.05, 0.05, 0.05])


def test_a_throttled_line_keeps_its_rate() -> None:
    _, times, _ = damaged(Chaos(bytes_s=1000), [bytes(100), bytes(100)])
    assert times == pytest.approx([n * 0.02 for n in range(1, 11)])


def test_a_lost_piece_is_late_and_so_are_those_after_it() -> None:
    chaos = Chaos(loss=0.2)
    _, times, figures = damaged(chaos, [b"x"] * 200)
    assert figures.late == 37
    assert times == sorted(times)
    assert max(due_s - n / 100 for n, due_s in enumerate(times)) == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("line", "command"),
    [
        ("", ProxyCommand(ways=("up", "down"))),
        ("off", ProxyCommand(ways=("up", "down"))),
        ("hole", ProxyCommand(ways=("up", "down"), chaos=Chaos(hole=True))),
        (
            "down delay_ms=50 loss=0.1",
            ProxyCommand(ways=("down",), chaos=Chaos(delay_ms=50, loss=0.1)),
        ),
        ("up off", ProxyCommand(ways=("up",))),
        ("cut", ProxyCommand(cut="fin")),
        ("cut=rst", ProxyCommand(cut="rst")),
        ("unplug", ProxyCommand(unplugged=True)),
        ("plug", ProxyCommand(unplugged=False)),
        ("figures", ProxyCommand(figures=True)),
    ],
)
def test_a_command_is_parsed(line: str, command: ProxyCommand) -> None:
    assert parse_command(line) == command


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("holes", r"no fault 'holes'; did you mean 'hole'\? known: .*bytes_s, corrupt"),
        ("corrupt=2", r"'corrupt=2': corrupt: expected a number <= 1.0"),
        ("delay_ms=nan", "delay_ms=nan"),
        ("hole cut", "no fault 'cut'"),
    ],
)
def test_a_wrong_command_is_refused_in_one_line(line: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        parse_command(line)
