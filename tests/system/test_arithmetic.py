"""Recorded drives are replayed with the same arithmetic on every x86-64 processor."""

import os
import platform
import subprocess
import sys

import pytest

from gigabrain_zenoh.recording.arithmetic import X86_64

SHOW = """
import gigabrain_zenoh.recording.arithmetic
import numpy
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__
wide = (name for name in __cpu_dispatch__ if name == "X86_V4" or name.startswith("AVX512"))
print([name for name in wide if __cpu_features__[name]])
"""


@pytest.mark.skipif(platform.machine() not in X86_64, reason="other processors compute as they do")
def test_numpy_leaves_out_what_not_every_processor_has() -> None:
    told = {name: os.environ[name] for name in ("OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES")}
    assert told["OPENBLAS_CORETYPE"]
    done = subprocess.run(
        (sys.executable, "-W", "error", "-c", SHOW), capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
