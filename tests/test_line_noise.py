"""What noise on the wire gets past a line's form and its checksum.

`let_through` with a million lines gave the table in docs/firmware_line.md.
"""

from collections import deque

import numpy as np
import pytest

from gigabrain_drivers.protocols.line import Decoder, Template
from gigabrain_drivers.protocols.line_fields import COMMAND

CHUNK = 1000  # lines


def let_through(check: str, byte_errors: float, lines: int, seed: int = 0) -> tuple[int, int]:
    """(right, wrong) commands that were read of `lines`, one flipped bit in a share of bytes."""
    template = Template(f"V,{{linear_x:.3f}},{{angular_z:.3f}}{check}\n", COMMAND)
    noise, decoder = np.random.default_rng(seed), Decoder((template,))
    sent: deque[dict[str, float]] = deque(maxlen=2 * CHUNK)
    right = wrong = 0
    for _ in range(lines // CHUNK):
        speeds = noise.uniform((-0.4, -1.2), (0.4, 1.2), (CHUNK, 2)).round(3).tolist()
        chunk = [{"linear_x": x + 0.0, "angular_z": z + 0.0} for x, z in speeds]
        sent.extend(chunk)
        data = np.frombuffer(b"".join(map(template.encode, chunk)), np.uint8).copy()
        hit = noise.random(len(data)) < byte_errors
        data[hit] ^= 1 << noise.integers(0, 8, int(hit.sum()), np.uint8)
        known = {(c["linear_x"], c["angular_z"]) for c in sent}
        for values in decoder.feed(data.tobytes()):
            if (values["linear_x"], values["angular_z"]) in known:
                right += 1
            else:
                wrong += 1
    return right, wrong


def test_a_bare_line_lets_some_wrong_commands_through() -> None:
    right, wrong = let_through("", 0.001, 8_000)
    assert right > 7_500
    assert 3 < wrong < 100


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
