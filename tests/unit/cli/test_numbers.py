"""Numbers that a command takes are finite, wherever they stand in its line."""

import pytest

from gigabrain_zenoh.cli.app import _call

LINES = [
    ("arm goto {} 0 0.1", "X"),
    ("arm goto 0.2 0 0.1 --pitch {}", "--pitch"),
    ("arm jog wrist_roll {}", "DISTANCE"),
    ("arm pick 0.2 {} 0 --sphere 0.02", "Y"),
    ("arm pick 0.2 0 0 --sphere {}", "--sphere"),
    ("arm pick 0.2 0 0 --box 0.1 {} 0.1", "--box"),
    ("arm pick 0.2 0 0 --sphere 0.02 --yaw {}", "--yaw"),
    ("arm place 0.2 0 {}", "Z"),
    ("arm press {} 0 0", "X"),
    ("arm press 0.2 0 0 --depth {}", "--depth"),
    ("arm press 0.2 0 0 --pitch {}", "--pitch"),
    ("arm hand-over --pitch {}", "--pitch"),
    ("arm hand-over --to 0.2 {} 0", "--to"),
    ("pose 0 0 {}", "YAW"),
    ("world add box {} 0", "X"),
    ("driver trace mock --linear-x {}", "--linear-x"),
]


@pytest.mark.parametrize(("line", "name"), LINES)
@pytest.mark.parametrize("value", ["nan", "inf"])
def test_a_number_that_is_not_finite_is_named(
    line: str, name: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _call(line.format(value).split()) == 2
    assert capsys.readouterr().err == f"gigabrain: {name}: expected a number, got {value}\n"


@pytest.mark.parametrize("value", ["1.5", "nan"])
def test_a_whole_number_is_not_rounded(value: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert _call(["bench", "plan", "--seed", value]) == 2
    said = f"gigabrain: --seed: expected a whole number, got {value}\n"
    assert capsys.readouterr().err == said
