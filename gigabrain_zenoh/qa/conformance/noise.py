"""What noise on the wire gets past a line's form and its checksum.

`let_through` with a million lines gave the table in docs/firmware_line.md.
"""

from collections import deque

import numpy as np

from gigabrain_drivers.bodies.line.fields import COMMAND
from gigabrain_drivers.bodies.line.protocol import Decoder, Template

CHUNK = 1000  # lines
GARBAGE = 64  # bytes, at most


def commands(check: str) -> Template:
    """A line of two speeds with this at its end, such as `*{crc16}`."""
    return Template(f"V,{{linear_x:.3f}},{{angular_z:.3f}}{check}\n", COMMAND)


def let_through(check: str, byte_errors: float, lines: int, seed: int = 0) -> tuple[int, int]:
    """(right, wrong) commands that were read of `lines`, one flipped bit in a share of bytes."""
    template = commands(check)
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


def lost_after_garbage(check: str, times: int, seed: int = 0) -> int:
    """The most whole lines in a row that were not read after garbage, of so many tries."""
    template, noise = commands(check), np.random.default_rng(seed)
    line, worst = template.encode({"linear_x": 0.2, "angular_z": 0.1}), 0
    for _ in range(times):
        decoder = Decoder((template,))
        decoder.feed(noise.bytes(int(noise.integers(1, GARBAGE))))
        lost = 0
        while not decoder.feed(line):
            lost += 1
        worst = max(worst, lost)
    return worst
