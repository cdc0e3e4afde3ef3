import os
import subprocess
import sys

import pytest

from tests.system.children import CHILD

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="the supervisor is for POSIX hosts"),
]


def lifeline_exit(code: str, variable: str | None) -> int:
    env = {k: v for k, v in os.environ.items() if k != "GIGABRAIN_SUPERVISOR"}
    env |= {"GIGABRAIN_SUPERVISOR": variable} if variable is not None else {}
    return subprocess.run([sys.executable, "-c", CHILD + code], env=env, check=False).returncode


def test_a_child_ends_if_its_supervisor_died_before_its_start() -> None:
    assert lifeline_exit("lifeline.die_with_supervisor(); sys.exit(7)", "1") == -9


@pytest.mark.parametrize("variable", [None, "", "nonsense"])
def test_a_process_without_a_supervisor_is_not_ended(variable: str | None) -> None:
    assert lifeline_exit("lifeline.die_with_supervisor(); sys.exit(7)", variable) == 7


def test_grandchildren_do_not_inherit_the_lifeline() -> None:
    code = "lifeline.die_with_supervisor(); sys.exit('GIGABRAIN_SUPERVISOR' in os.environ)"
    assert lifeline_exit(code, str(os.getpid())) == 0
