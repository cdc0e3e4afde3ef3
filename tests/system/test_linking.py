"""Linked kernels: they run without numba, and give its results."""

import asyncio
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("numba")

from gigabrain_zenoh.kernels import cache, precompile
from gigabrain_zenoh.kernels.linked import INDEX, LIBRARY, load_all

KERNELS = """
from typing import NamedTuple
import numpy as np
from gigabrain_zenoh.kernels.jit import kernel, lean_kernel

class Line(NamedTuple):
    slope: float
    points: np.ndarray

@lean_kernel
def at(line, x):
    return line.slope * x

@kernel
def along(line, offset):
    out = np.empty(len(line.points), np.float64)
    for i in range(len(out)):
        out[i] = at(line, line.points[i]) + offset[1]
    return Line(offset[0], out), len(out)

@kernel
def count(upto):
    total = 0.0
    for i in range(upto):
        total += np.sqrt(float(i % 7))
    return total

@kernel
def refuse(index):
    if index > 2:
        raise ValueError("too large")
    return index

def warm_up():
    along(Line(2.0, np.arange(3.0)), (1.0, 0.5))
    count(3)
    refuse(1)
"""
USES = """
import sys, threading
import numpy as np
from mine import Line, along, count, refuse
def by_numba():
    return "numba" in sys.modules
"""
ALONG = "line, number = along(Line(2.0, {}), (1.0, 0.5)); print(*line.points, number, by_numba())"
RUNS_BESIDE = """
seen, over = 0, threading.Event()
def work():
    count(100_000_000)
    over.set()
thread = threading.Thread(target=work)
thread.start()
while not over.is_set():
    seen += 1
    over.wait(0.001)
thread.join()
print(seen > 5, by_numba())
"""
REFUSES = """
try:
    refuse(3)
except ValueError as error:
    print(error, by_numba())
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a module of kernels, and a cache folder with their library."""
    if not precompile.can_link():
        pytest.skip("there is no C++ compiler here, no Python.h, or no setuptools")
    place = tmp_path_factory.mktemp("linking")
    (place / "mine.py").write_text(KERNELS)
    with pytest.MonkeyPatch.context() as patched:
        patched.syspath_prepend(str(place))
        patched.setenv(cache.FOLDER, str(place / "kept"))
        assert asyncio.run(precompile.link_in_child("mine", "mine:warm_up")) == 0
    return place


def run(place: Path, program: str) -> str:
    """Run a program that uses the kernels; return its output."""
    paths = os.pathsep.join((str(place), *filter(None, sys.path)))
    environment = os.environ | {cache.FOLDER: str(place / "kept"), "PYTHONPATH": paths}
    done = subprocess.run(
        (sys.executable, "-c", USES + program), capture_output=True, text=True, env=environment
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_linked_kernel_runs_without_numba(place: Path) -> None:
    assert run(place, ALONG.format("np.arange(3.0)")) == "0.5 2.5 4.5 3 False"


@pytest.mark.parametrize(
    "points",
    ["np.arange(3.0, dtype=np.float32)", "np.arange(0.0, 3.0, 0.5)[::2]", "np.arange(3)"],
)
def test_numba_compiles_a_kernel_for_other_argument_types(place: Path, points: str) -> None:
    assert run(place, ALONG.format(points)) == "0.5 2.5 4.5 3 True"


def test_a_linked_kernel_releases_the_gil(place: Path) -> None:
    assert run(place, RUNS_BESIDE) == "True False"


def test_a_linked_kernel_raises_its_exceptions(place: Path) -> None:
    assert run(place, REFUSES) == "too large False"


@pytest.fixture
def load_again() -> Iterator[Callable[[], None]]:
    """Forget the loaded libraries, now and after the test."""
    load_all.cache_clear()
    yield load_all.cache_clear
    load_all.cache_clear()


def test_after_a_change_of_any_kernel_the_library_is_not_used(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, load_again: Callable[[], None]
) -> None:
    monkeypatch.setenv(cache.FOLDER, str(place / "kept"))
    assert set(load_all()) == {"mine:along", "mine:count", "mine:refuse"}
    monkeypatch.setattr(cache, "PACKAGE", tmp_path)
    load_again()
    assert load_all() == {}


@pytest.mark.parametrize("end", [INDEX, LIBRARY])
def test_with_a_broken_library_numba_compiles(
    end: str,
    place: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    load_again: Callable[[], None],
) -> None:
    for file in (place / "kept").glob(f"mine{cache.suffix()}.*"):
        shutil.copy(file, tmp_path)
    (broken,) = tmp_path.glob(f"*{end}")
    broken.write_bytes(b"\0")
    monkeypatch.setenv(cache.FOLDER, str(tmp_path))
    assert load_all() == {}
    (index,) = tmp_path.glob(f"*{INDEX}")
    assert caplog.text.rstrip().endswith(f"remove {index}")


def test_without_a_compiler_nothing_can_be_linked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert not precompile.can_link()


SAME = """
import copy
import numpy as np
from gigabrain_zenoh.kernels import jit
from gigabrain_zenoh.kernels.linked import INDEX, LIBRARY, load_all

assert load_all()
linked_call, compared = jit.Kernel.__call__, set()

def same(one, other):
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return np.array_equal(one, other, equal_nan=np.asarray(one).dtype.kind == "f")

def call_both(kernel, *arguments):
    copied = copy.deepcopy(arguments)
    result = linked_call(kernel, *arguments)
    assert not kernel.called, f"{kernel.name} is not linked for {arguments}"
    assert same(result, kernel.dispatcher(*copied)), kernel.name
    assert same(arguments, copied), kernel.name  # what it writes
    compared.add(kernel.name)
    return result

jit.Kernel.__call__ = call_both
from gigabrain_zenoh.decision import navigator
from gigabrain_zenoh.mapping import static_map
from gigabrain_zenoh.navigation import car_planner
from gigabrain_zenoh.qa.bench.slam_world import map_world
navigator.warm_up()
car_planner.warm_up()
static_map.warm_up()
map_world("turtlebot3_waffle", "house", 0, 0.2, lambda _: None)
print(len(compared))
"""


def test_linked_kernels_equal_numba_to_the_last_bit() -> None:
    if not load_all():
        pytest.skip("the kernels are not linked here")
    environment = os.environ | {"MALLOC_PERTURB_": "1"}  # equal bytes in uninitialised memory
    done = subprocess.run(
        (sys.executable, "-c", SAME), capture_output=True, text=True, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 30
