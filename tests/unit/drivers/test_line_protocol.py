"""Lines of text by template: encoded, decoded, and refused if invalid."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_drivers.bodies.line.protocol import (
    CHECKS,
    COMMAND,
    MAX_LINE_BYTES,
    STATE,
    UNITS,
    LineDecoder,
    Template,
    factor,
)

BARE = Template("V,{linear_x:.3f},{angular_z:.3f}\n", COMMAND)
TICKS = Template(
    "S,{wheel_left_position|tick:d},{wheel_right_position|tick:d},{battery_voltage|mV:d},"
    "{wheel_left_temperature|0.1C:d},{flags:02X}*{crc16}\n",
    STATE,
    4096,
)


def test_a_command_line_has_these_bytes() -> None:
    line = BARE.encode({"linear_x": 0.1, "angular_z": 0.5})
    assert line == bytes.fromhex("562c302e3130302c302e3530300a")  # V,0.100,0.500


@pytest.mark.parametrize(
    ("name", "value"),
    [("xor8", 0x31), ("crc8", 0xF4), ("crc16", 0x29B1), ("crc32", 0xCBF43926)],
)
def test_checksums_of_the_usual_check_string(name: str, value: int) -> None:
    assert CHECKS[name].of(b"123456789") == value


def test_an_nmea_0183_sentence_decodes() -> None:
    template = Template("$GPGLL,{_},N,{_},W,{_},A*{xor8}\n", STATE)
    assert template.decode(b"$GPGLL,4916.45,N,12311.12,W,225444,A*31") == {}
    assert template.decode(b"$GPGLL,4916.45,N,12311.12,W,225445,A*31") is None


def test_a_state_line_decodes_to_si_units() -> None:
    line = b"S,-4096,2048,12345,315,0A*"
    crc = CHECKS["crc16"].of(line[:-1])
    values = TICKS.decode(line + f"{crc:04X}".encode())
    assert values is not None
    assert values["wheel_left_position"] == pytest.approx(-math.tau)
    assert values["wheel_right_position"] == pytest.approx(math.pi)
    assert values["battery_voltage"] == pytest.approx(12.345)
    assert values["wheel_left_temperature"] == pytest.approx(31.5)
    assert values["flags"] == 0x0A


def test_a_state_line_has_this_crc() -> None:
    values = {"wheel_left_position": math.tau, "battery_voltage": 12.0, "flags": 1.0}
    assert TICKS.encode(values) == b"S,4096,0,12000,0,01*563E\n"


@given(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0))
def test_a_command_round_trips_to_its_last_digit(x: float, z: float) -> None:
    line = BARE.encode({"linear_x": x, "angular_z": z}, toward_zero=True)
    values = BARE.decode(line[:-1])
    assert values is not None
    assert values == {"linear_x": BARE.sent("linear_x", x), "angular_z": BARE.sent("angular_z", z)}
    assert 0 <= abs(x) - abs(values["linear_x"]) + 1e-8 <= 0.0010001


@given(st.data())
def test_every_field_round_trips_in_every_unit(data: st.DataObject) -> None:
    for known in (COMMAND, STATE):
        name = data.draw(st.sampled_from([n for n in known if n != "_"]))
        unit = data.draw(st.sampled_from(list(UNITS[known[name]])))
        whole = known[name] in ("count", "flags")
        value = float(data.draw(st.integers(0, 65535))) if whole else data.draw(st.floats(-50, 50))
        form = "" if whole else ":.6f"
        template = Template(f"X {{{name}|{unit}{form}}} *{{crc32}}\r\n", known, 4096)
        back = template.decode(template.encode({name: value})[:-2])
        assert back is not None
        assert back[name] == pytest.approx(value, abs=2e-5)


def test_zero_has_no_sign() -> None:
    assert BARE.encode({"linear_x": -0.0001, "angular_z": -0.0}) == b"V,0.000,0.000\n"
    assert str(BARE.sent("linear_x", -0.0001)) == "0.0"


def test_a_unit_may_have_a_number_before_it_and_a_sign() -> None:
    assert factor("temperature", "0.1C", None) == pytest.approx(0.1)
    assert factor("speed", "0.01 m/s", None) == pytest.approx(0.01)
    assert factor("angle", "-tick", 4096) == pytest.approx(-math.tau / 4096)
    assert factor("turning speed", "rpm", None) == pytest.approx(0.10471976)
    with pytest.raises(ValueError, match="it is a voltage: expected V or mV"):
        factor("voltage", "0.1", None)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("V,{liner_x}\n", "no field 'liner_x'; did you mean 'linear_x'"),
        ("V,{linear_x", "expected a newline"),
        (r"V,{linear_x}\n", "in YAML, write it in double quotes"),
        ("V,{linear_x|rpm}\n", r"\{linear_x\}: it is a speed: expected m/s or cm/s or mm/s"),
        ("V,{linear_x|0m/s}\n", "expected a number other than 0"),
        ("V,{linear_x:.3q}\n", r"\{linear_x\}: expected a format such as .3f, d or 02x"),
        ("V,{linear_x:x}\n", "a speed has a sign"),
        ("V,{linear_x},{linear_x}\n", "linear_x stands in it twice"),
        ("V,{linear_x},{\n", "a brace without its partner"),
        ("V,}{linear_x}\n", "a brace without its partner"),
        ("V,{crc16},{linear_x}\n", r"the checksum \{crc16\} must stand last"),
        ("V,{linear_x}*{crc16};\n", r"the checksum \{crc16\} must stand last"),
        ("V\n", "there is no field in it"),
        ("V,{wheel_steering|tick}\n", "'tick' needs `ticks_per_turn`"),
        ("Ü,{linear_x}\n", "expected printable ASCII"),
        ("V\x07,{linear_x}\n", "expected printable ASCII"),
        ("V" * 300 + ",{linear_x}\n", "expected at most 256 characters"),
        ("V,{linear_x!r}\n", "no field"),
        ("V,{linear_x.__class__}\n", "no field"),
    ],
)
def test_a_mistake_in_a_template_is_explained(text: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        Template(text, COMMAND)


@pytest.mark.parametrize(
    "line",
    [
        b"V,nan,0.000", b"V,inf,0.000", b"V,-inf,0.000", b"V,1e3,0.000", b"V,0x1p3,0.000",
        b"V,0.10,0.500", b"V,0.1000,0.500", b"V,.100,0.500", b"V,0.100", b"V,0.100,0.500,",
        b" V,0.100,0.500", b"v,0.100,0.500", b"V,+0.100,0.500", b"V,--0.100,0.500", b"",
        b"V,0.100,0.500V,0.100,0.500", b"V,0,100,0.500", "V,\u0660.100,0.500".encode(),
        b"V,0.100,0.500\x00", b"V,1_0.000,0.500", b"V,9999999999999.000,0.000",
    ],
)  # fmt: skip
def test_a_line_that_does_not_match_exactly_is_refused(line: bytes) -> None:
    assert BARE.decode(line) is None


def test_a_number_without_a_format_may_be_padded_and_short() -> None:
    template = Template("O {linear_x} {angular_z}\n", STATE)
    assert template.decode(b"O   0.5 -1.") == {"linear_x": 0.5, "angular_z": -1.0}
    assert template.decode(b"O 1e9 0") is None


def lines(count: int) -> list[bytes]:
    return [BARE.encode({"linear_x": n / 1000, "angular_z": 0.5}) for n in range(count)]


@given(st.lists(st.integers(1, 40), min_size=1, max_size=30))
def test_lines_are_found_in_pieces_of_any_size(cuts: list[int]) -> None:
    data, decoder, found = b"".join(lines(20)), LineDecoder((BARE,)), []
    for cut in cuts:
        found += decoder.feed(data[:cut])
        data = data[cut:]
    found += decoder.feed(data)
    assert [values["linear_x"] for values in found] == [n / 1000 for n in range(20)]
    assert decoder.errors == 0


def test_a_banner_is_no_error_but_an_invalid_line_after_it_is() -> None:
    decoder = LineDecoder((BARE,))
    decoder.feed(b"\xff\x00Arduino\r\nbooting\r\n" + lines(1)[0])
    assert decoder.errors == 0
    decoder.feed(b"oops\n\n" + lines(1)[0])
    assert decoder.errors == 1


def test_a_line_that_is_too_long_is_one_error_and_the_next_one_is_read() -> None:
    decoder = LineDecoder((BARE,))
    decoder.feed(lines(1)[0])
    for _ in range(50):
        decoder.feed(b"x" * 100)
    assert len(decoder._rest) <= MAX_LINE_BYTES
    assert decoder.feed(b"\n" + lines(1)[0]) == [{"linear_x": 0.0, "angular_z": 0.5}]
    assert decoder.errors == 1


@given(st.binary(max_size=2000))
def test_the_decoder_never_raises_and_keeps_at_most_one_line(data: bytes) -> None:
    decoder = LineDecoder((BARE, TICKS))
    decoder.feed(data)
    assert len(decoder._rest) <= MAX_LINE_BYTES


def test_lines_may_end_with_crlf_or_lf() -> None:
    template = Template("V,{linear_x:.3f}\r\n", COMMAND)
    assert LineDecoder((template,)).feed(b"V,0.100\r\nV,0.200\n") == [
        {"linear_x": 0.1},
        {"linear_x": 0.2},
    ]


def test_a_line_with_a_checksum_and_one_flipped_bit_is_refused() -> None:
    line = TICKS.encode({"wheel_left_position": 3.0, "battery_voltage": 12.0})[:-1]
    right = TICKS.decode(line)
    for bit in range(8 * len(line)):
        flipped = bytearray(line)
        flipped[bit // 8] ^= 1 << bit % 8
        assert TICKS.decode(bytes(flipped)) in (None, right)  # hex digits may be of either case


def test_a_flipped_bit_is_not_noticed_without_a_checksum() -> None:
    line = bytearray(b"V,0.100,0.500")
    line[4] ^= 8  # 1 -> 9
    assert BARE.decode(bytes(line)) == {"linear_x": 0.9, "angular_z": 0.5}
