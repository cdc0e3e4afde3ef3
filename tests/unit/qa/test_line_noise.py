"""Errors on the wire that a line's form and its checksum do not detect."""

import pytest

from gigabrain_zenoh.qa.faults.rows.body_line import let_through, lost_after_garbage


def test_a_bare_line_lets_some_wrong_commands_through() -> None:
    right, wrong = let_through("", 0.001, 8_000)
    assert right > 7_500
    assert 3 < wrong < 100


@pytest.mark.long
@pytest.mark.parametrize("check", ["*{crc16}", "*{crc32}"])
@pytest.mark.parametrize("byte_errors", [0.001, 0.05])
def test_a_checksum_of_sixteen_bits_lets_next_to_none_through(
    check: str, byte_errors: float
) -> None:
    right, wrong = let_through(check, byte_errors, 8_000)
    assert right > 2_000
    assert wrong <= 2


def test_without_noise_every_line_is_right() -> None:
    assert let_through("*{crc16}", 0.0, 5_000) == (5_000, 0)


@pytest.mark.parametrize("check", ["", "*{crc16}"])
def test_garbage_costs_no_more_than_the_next_line(check: str) -> None:
    assert lost_after_garbage(check, 500) == 1
