"""The pure steps of safety and gate import few modules."""

import subprocess
import sys

import pytest

COUNT = """
import sys
import {module}
print(sum(name.startswith(("gigabrain_zenoh", "gigabrain_schemas")) for name in sys.modules))
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("module", "limit"), [("gigabrain_zenoh.safety.step", 34), ("gigabrain_zenoh.gate.gate", 15)]
)
def test_a_pure_step_imports_few_modules(module: str, limit: int) -> None:
    done = subprocess.run(
        (
            sys.executable,
            "-c",
            f"import sys; sys.path[:] = {sys.path!r}{COUNT.format(module=module)}",
        ),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) <= limit
