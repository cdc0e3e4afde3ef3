"""Every decoder against bytes at random, damaged good input, and what broke one before.

`make fuzz` looks further, guided by coverage; what it finds is kept in tests/fuzz/corpus.
"""

import random
from types import ModuleType

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tests.fuzz import lines, messages, notes, yaml_files
from tests.fuzz.harness import CORPUS

MODULES = {"lines": lines, "messages": messages, "notes": notes, "yaml_files": yaml_files}
DAMAGED = 3  # inputs made of each good one

by_module = pytest.mark.parametrize("name", sorted(MODULES))


def kept(name: str) -> list[bytes]:
    return [path.read_bytes() for path in sorted((CORPUS / name).iterdir())]


@by_module
def test_what_broke_a_decoder_once_does_so_no_more(name: str) -> None:
    inputs = kept(name)
    assert inputs
    for data in inputs:
        MODULES[name].check(data)


@pytest.mark.long
@by_module
def test_what_is_good_is_taken(name: str) -> None:
    for data in MODULES[name].seeds():
        MODULES[name].check(data)


@pytest.mark.long
@by_module
def test_what_is_damaged_is_refused_or_still_right(name: str) -> None:
    module, chance = MODULES[name], random.Random(name)
    for data in module.seeds():
        for _ in range(DAMAGED):
            module.check(damaged(module, data, chance))


def damaged(module: ModuleType, data: bytes, chance: random.Random) -> bytes:
    """With its first line left whole: bytes flipped, cut out, doubled, or put in."""
    at = data.index(b"\n") + 1
    body = bytearray(data[at:])
    for _ in range(chance.randint(1, 4)):
        place, size = chance.randint(0, len(body)), chance.randint(1, 16)
        match chance.randrange(4):
            case 0 if place < len(body):
                body[place] ^= 1 << chance.randrange(8)
            case 1:
                del body[place : place + size]
            case 2:
                body[place:place] = body[place : place + size]
            case _:
                body[place:place] = chance.randbytes(size)
    return data[:at] + bytes(body)


@given(name=st.sampled_from(lines.NAMES), data=st.binary(max_size=600))
@example(name="protocol line", data=b"\xff" * 600)
def test_bytes_at_random_on_a_line_break_nothing(name: str, data: bytes) -> None:
    lines.TARGETS[name](data)


@given(name=st.sampled_from(sorted(lines.SEALS)), data=st.binary(min_size=172, max_size=900))
def test_well_formed_nonsense_from_a_body_is_no_invalid_state(name: str, data: bytes) -> None:
    lines.sealed(name, data)


@given(kind=st.sampled_from(yaml_files.KINDS), text=st.text(max_size=300))
def test_text_at_random_is_refused_in_one_line_or_a_configuration(kind: str, text: str) -> None:
    yaml_files.check(f"{kind}\n{text}".encode("utf-8", "replace"))


@given(kind=st.sampled_from(sorted(notes.CHECKS)), data=st.binary(max_size=300))
def test_bytes_at_random_in_a_small_file_break_nothing(kind: str, data: bytes) -> None:
    notes.CHECKS[kind](data)
