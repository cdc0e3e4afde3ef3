import enum
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta

from gigabrain_zenoh.config.loading import load, loads
from gigabrain_zenoh.errors import ConfigError

Speed = Annotated[float, Meta(ge=0.01)]


class Colour(enum.Enum):
    RED = "red"
    GREEN = "green"


class Behaviour(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    behaviour: str = "avoid"
    turn: Literal["left", "right", "clearer"] = "right"


class Simulated(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="link", tag="sim"
):
    model: str


class Serial(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="link", tag="serial"
):
    port: str
    baud: Annotated[int, Meta(ge=1200, le=4_000_000)] = 115200


class Window(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    low: float = 0.0
    high: float = 1.0

    def __post_init__(self) -> None:
        if self.low >= self.high:
            raise ValueError(f"low {self.low} must be below high {self.high}")


class Robot(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    robot_type: str
    max_linear_speed: Speed
    drive: Behaviour = Behaviour()
    links: dict[str, Simulated | Serial] = {}
    windows: list[Window] = []
    fallback: Behaviour | None = None
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    caps: dict[str, Speed] = {}
    colour: Colour = Colour.RED
    lamps: int = 0
    active: bool = False
    note: str | None = None


HEAD = "robot_type: waffle\nmax_linear_speed: 0.26\n"


def refusal(text: str, source: str = "robot.yaml") -> str:
    with pytest.raises(ConfigError) as caught:
        loads(text, Robot, source)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_good_file_becomes_its_struct(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(HEAD + "drive: {turn: clearer}\nlinks:\n  real: {link: serial, port: a}\n")
    assert load(path, Robot) == Robot(
        "waffle", 0.26, Behaviour(turn="clearer"), {"real": Serial("a")}
    )


def test_a_byte_order_mark_changes_nothing() -> None:
    for text in (HEAD, f"# a robot\n{HEAD}", f"---\n{HEAD}"):
        assert loads(f"\ufeff{text}", Robot, "robot.yaml") == loads(text, Robot, "robot.yaml")


def test_numbers_are_read_as_people_write_them() -> None:
    robot = loads(HEAD + "mount: [1e-3, +2, -.5]\nlamps: 0\n", Robot, "robot.yaml")
    assert robot.mount == (0.001, 2.0, -0.5)


def test_text_that_looks_like_a_date_or_a_number_in_quotes_stays_text() -> None:
    assert loads(HEAD + "note: 2026-13-45\n", Robot, "r").note == "2026-13-45"
    assert loads(HEAD + "note: '1e3'\n", Robot, "r").note == "1e3"
    assert loads(HEAD + "note: =\n", Robot, "r").note == "="


@pytest.mark.parametrize(
    ("rest", "said"),
    [
        ("lamps: 1\nlamps: 2\n", "robot.yaml:4: duplicate key 'lamps', first on line 3"),
        ("drive:\n  turn: left\n  turn: left\n", "robot.yaml:5: duplicate key 'turn', first on"),
        ("drive: {<<: {turn: left}}\n", "robot.yaml:3: merge key '<<' is not allowed;"),
        ("caps: &a {x: 1.0}\nmount: *a\n", "robot.yaml:4: alias '*a' is not allowed;"),
        ("lamps: 12:30\n", "robot.yaml:3: '12:30': write it as a plain decimal or quote it"),
        ("lamps: 010\n", "robot.yaml:3: '010': write it as a plain decimal or quote it"),
        ("lamps: 0x1F\n", "robot.yaml:3: '0x1F': write it as a plain decimal or quote it"),
        ("lamps: 1_000\n", "robot.yaml:3: '1_000': write it as a plain decimal or quote it"),
        ("lamps: " + "9" * 5000 + "\n", "robot.yaml:3: '9999"),
        ("active: yes\n", "robot.yaml:3: 'yes' is read as a boolean; write true or false,"),
        ("note: No\n", "robot.yaml:3: 'No' is read as a boolean; write true or false, or quote"),
        ("on: 1\n", "robot.yaml:3: key 'on' is not read as a name; quote it"),
        ("? [a]\n: 1\n", "robot.yaml:3: a key is a list or a mapping; expected a name"),
        ("caps: {x: .nan}\n", "robot.yaml:3: .nan is not allowed; expected a finite number"),
        ("caps: {x: -.inf}\n", "robot.yaml:3: -.inf is not allowed; expected a finite number"),
        ("caps: {x: 1.0e+999}\n", "robot.yaml:3: 1.0e+999 is too large; expected a finite number"),
        ("note: !!python/object:os.system x\n", "robot.yaml:3: tag 'tag:yaml.org,2002:python/"),
        ("mount: [1, 2\nlamps: 1\n", "robot.yaml:4: not YAML: "),
        ("note: 'open\n", "robot.yaml:4: not YAML: "),
        ("note: a\x01\n", "robot.yaml:3: not YAML: "),
        ("---\na: 1\n", "robot.yaml:3: a second document begins here; expected one"),
        ("mount: " + "[" * 400_000, "robot.yaml:3: nested too deeply; expected at most 32 levels"),
    ],
)
def test_yaml_that_surprises_is_refused_with_its_line(rest: str, said: str) -> None:
    assert refusal(HEAD + rest).startswith(said)


@pytest.mark.parametrize("text", ["", "\n\n", "# only a comment\n"])
def test_an_empty_file_is_refused(text: str) -> None:
    assert refusal(text) == "robot.yaml:1: the file is empty; expected a mapping of fields"


@pytest.mark.parametrize("text", ["- a\n", "waffle\n", "~\n", "3\n"])
def test_a_file_that_is_no_mapping_is_refused(text: str) -> None:
    assert refusal(text).startswith("robot.yaml:1: expected a mapping, got ")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "robot_type: waffle\nmax_linear_speed: 0.2\ndrive:\n  turm: left\n",
            "deploy/demo.yaml:4: unknown field 'turm'; did you mean 'turn'? known: behaviour, turn",
        ),
        (
            HEAD + "fallback:\n  zzz: left\n",
            "deploy/demo.yaml:4: unknown field 'zzz'; known: behaviour, turn",
        ),
        (
            HEAD + "links:\n  real:\n    link: serial\n    port: a\n    buad: 1\n",
            "deploy/demo.yaml:7: unknown field 'buad'; did you mean 'baud'? "
            "known: baud, link, port",
        ),
        (
            HEAD + "windows:\n  - low: 0.1\n  - high: 2\n    lwo: 1\n",
            "deploy/demo.yaml:6: unknown field 'lwo'; did you mean 'low'? known: high, low",
        ),
    ],
)
def test_an_unknown_field_is_named_on_its_own_line(text: str, said: str) -> None:
    assert refusal(text, "deploy/demo.yaml") == said


@pytest.mark.parametrize(
    ("rest", "said"),
    [
        ("lamps: 1.5\n", "3: lamps: expected a whole number, got 1.5"),
        ("lamps: true\n", "3: lamps: expected a whole number, got true"),
        ("lamps:\n", "3: lamps: expected a whole number, got nothing"),
        ("active: 1\n", "3: active: expected true or false, got 1"),
        ("note: 12\n", "3: note: expected a string or null, got 12"),
        ("note: 1e3\n", "3: note: expected a string or null, got 1e3"),
        ("mount: [1, 2]\n", "3: mount: expected a list of 3, got a list of 2"),
        ("mount:\n  - 1\n  - a\n  - 3\n", "5: mount[1]: expected a number, got 'a'"),
        ("mount: here\n", "3: mount: expected a list of 3, got 'here'"),
        ("caps:\n  left: 1\n  right: 0\n", "5: caps.right: expected a number >= 0.01, got 0"),
        ("caps: [1]\n", "3: caps: expected a mapping, got a list of 1"),
        ("fallback: 3\n", "3: fallback: expected a mapping or null, got 3"),
        ("colour: gren\n", "3: colour: expected one of 'red', 'green', got 'gren'; did you mean"),
        (
            "drive:\n  turn: rihgt\n",
            "4: drive.turn: expected one of 'clearer', 'left', 'right', got 'rihgt'; "
            "did you mean 'right'?",
        ),
        (
            "links:\n  real: {link: seral, port: a}\n",
            "4: links.real.link: expected one of 'sim', 'serial', got 'seral'; "
            "did you mean 'serial'?",
        ),
        (
            "links:\n  a:\n    link: [sim]\n",
            "5: links.a.link: expected one of 'sim', 'serial'",
        ),
        (
            "links:\n  real:\n    port: a\n",
            "4: links.real: missing field 'link'; expected one of 'sim', 'serial'",
        ),
        (
            "links:\n  real:\n    link: serial\n",
            "4: links.real: missing field 'port'; expected a string",
        ),
        (
            "links:\n  real:\n    link: serial\n    port: a\n    baud: 300\n",
            "7: links.real.baud: expected a whole number >= 1200 and <= 4000000, got 300",
        ),
        ("windows:\n- low: 2\n", "4: windows[0]: low 2.0 must be below high 1.0"),
        ("links: {a: 3}\n", "3: links.a: expected a mapping, got 3"),
        ("note: []", "3: note: expected a string or null, got a list of 0"),
    ],
)
def test_a_wrong_value_is_named_with_line_path_and_what_was_expected(rest: str, said: str) -> None:
    assert refusal(HEAD + rest).startswith("robot.yaml:" + said)


def test_a_number_out_of_range_reads_as_promised() -> None:
    text = "\n" * 5 + "robot_type: waffle\nmax_linear_speed: -1\n"
    assert refusal(text) == "robot.yaml:7: max_linear_speed: expected a number >= 0.01, got -1"


def test_a_missing_field_is_named_with_what_it_should_be() -> None:
    said = "robot.yaml:1: missing field 'max_linear_speed'; expected a number >= 0.01"
    assert refusal("robot_type: waffle\n") == said


def test_the_first_fault_in_the_order_of_the_file_is_reported() -> None:
    assert refusal("lamps: a\nturm: 1\n").startswith("robot.yaml:1: lamps: expected a whole")
    assert refusal("turm: 1\nlamps: a\n").startswith("robot.yaml:1: unknown field 'turm'")


def test_a_union_without_a_fitting_member_says_what_would_fit() -> None:
    class Either(msgspec.Struct, forbid_unknown_fields=True):
        value: int | list[int] = 0

    with pytest.raises(ConfigError) as caught:
        loads("value: [1, x]\n", Either, "f")
    assert str(caught.value) == "f:1: value[1]: expected a whole number, got 'x'"
    with pytest.raises(ConfigError) as caught:
        loads("value: {a: 1}\n", Either, "f")
    assert str(caught.value) == "f:1: value: expected a whole number or a list, got a mapping"


def test_keys_of_a_mapping_are_checked_too() -> None:
    class Named(msgspec.Struct, forbid_unknown_fields=True):
        hosts: dict[Annotated[str, Meta(pattern="^[a-z]+$")], Annotated[int, Meta(gt=0)]] = {}

    with pytest.raises(ConfigError) as caught:
        loads("hosts:\n  ok: 1\n  X1: 1\n", Named, "f")
    assert str(caught.value) == (
        "f:3: hosts: expected a string matching ^[a-z]+$ as the name, got 'X1'"
    )


def test_files_that_cannot_be_read_are_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "waffle.yaml").write_text(HEAD)
    (tmp_path / "latin.yaml").write_bytes(b"robot_type: waffle\nnote: caf\xe9\n")
    with pytest.raises(ConfigError, match=r"wafle\.yaml: no such file; did you mean .*waffle"):
        load(tmp_path / "wafle.yaml", Robot)
    with pytest.raises(ConfigError, match=r"no such file; expected a YAML file$"):
        load(tmp_path / "nowhere" / "x.yaml", Robot)
    with pytest.raises(ConfigError, match="is a folder; expected a file"):
        load(tmp_path, Robot)
    with pytest.raises(ConfigError, match=r"latin\.yaml:2: byte 0xe9; expected UTF-8 text"):
        load(tmp_path / "latin.yaml", Robot)
    with pytest.raises(ConfigError, match=r"cannot read .*: a part of the path is a file"):
        load(tmp_path / "waffle.yaml" / "x.yaml", Robot)


WORDS = ["links", "drive", "caps", "windows", "mount", "note", "turn", "link", "sim", "1e3"]
SIGNS = [*":-[]{},'\"&*!|>?#%@`~=\t\n", "<<", "1", "-1", ".nan", "0x1", "yes", "null", ": ", "\n "]


def outcome(text: str) -> str:
    try:
        loads(text, Robot, "robot.yaml")
    except ConfigError as error:
        return str(error)
    return "robot.yaml: good"


@given(st.lists(st.sampled_from(WORDS + SIGNS) | st.text(max_size=3), max_size=30))
def test_any_text_becomes_a_robot_or_one_line_of_error(pieces: list[str]) -> None:
    said = outcome(" ".join(pieces))
    assert said.startswith("robot.yaml:")
    assert len(said.splitlines()) == 1


def test_a_bad_configuration_ends_a_process_with_exit_code_2() -> None:
    assert ConfigError.exit_code == 2


def test_one_section_of_a_file_is_read_with_its_lines() -> None:
    text = "body: alpha\ndecision:\n  settings:\n    lin: 3\n"
    assert loads(text, dict[str, int], "a.yaml", ("decision", "settings")) == {"lin": 3}
    assert loads("body: alpha", dict[str, int], "a.yaml", ("decision", "settings")) == {}
    with pytest.raises(ConfigError, match=r"^a\.yaml:4: lin: expected a string, got 3$"):
        loads(text, dict[str, str], "a.yaml", ("decision", "settings"))
