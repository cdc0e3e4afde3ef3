"""Arithmetic of numpy: equal on every x86-64 processor for recorded drives, in one thread."""

import os
import platform
import subprocess
import sys

import pytest

from gigabrain_zenoh.recording.arithmetic import X86_64

SHOW_WIDE_FEATURES = """
import gigabrain_zenoh.recording.arithmetic
import numpy
from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__
wide = (name for name in __cpu_dispatch__ if name == "X86_V4" or name.startswith("AVX512"))
print([name for name in wide if __cpu_features__[name]])
"""


@pytest.mark.skipif(platform.machine() not in X86_64, reason="other processors compute as they do")
def test_numpy_uses_no_instructions_that_some_processors_lack() -> None:
    settings = {
        name: os.environ[name] for name in ("OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES")
    }
    assert settings["OPENBLAS_CORETYPE"]
    done = subprocess.run(
        (sys.executable, "-W", "error", "-c", SHOW_WIDE_FEATURES),
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "[]"


# code before `multiply_in_one_thread` must not import numpy; options must not import MuJoCo
SHOW_HEAVY_IMPORTS = """
import sys
import gigabrain_zenoh.cli.app, gigabrain_zenoh.launch.processes
print([name for name in ("numpy", "mujoco") if name in sys.modules])
import gigabrain_drivers.sim.driver
print("mujoco" in sys.modules)
"""
SHOW_THREADS = """
import os
from gigabrain_zenoh.host.this_process import multiply_in_one_thread
multiply_in_one_thread()
import numpy
print(os.environ["OPENBLAS_NUM_THREADS"], len(os.listdir("/proc/self/task")))
"""


def output_of(code: str, **env: str) -> str:
    """Return the output of a program that starts with default settings of numpy and `env`."""
    own = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    command = (sys.executable, "-W", "error", "-c", code)
    return subprocess.run(command, capture_output=True, text=True, check=True, env=own | env).stdout


def test_commands_and_processes_start_without_numpy_and_mujoco() -> None:
    assert output_of(SHOW_HEAVY_IMPORTS).split("\n") == ["[]", "False", ""]


@pytest.mark.skipif(sys.platform != "linux", reason="threads are counted in /proc")
def test_matrices_are_multiplied_in_one_thread_unless_the_environment_sets_more() -> None:
    assert output_of(SHOW_THREADS).split() == ["1", "1"]
    assert output_of(SHOW_THREADS, OPENBLAS_NUM_THREADS="2").split()[0] == "2"
