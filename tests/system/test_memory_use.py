"""Memory of large arrays and of start-up code goes back to the system."""

import subprocess
import sys

import pytest

MAPS_PROGRAM = """
import sys, threading
import numpy as np
from gigabrain_zenoh.host import this_process as heap

if "mapped" in sys.argv:
    heap.map_large_blocks()


def held_mb():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6


def plan():
    costs = [np.ones((2800, 2800), np.float32) for _ in range(2)]
    small = np.ones(1000)
    del costs
    return small


kept, before = [], held_mb()
for _ in range(3):
    threads = [threading.Thread(target=lambda: kept.append(plan())) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
print(held_mb() - before)
"""
MAX_GROWTH_MB = 5.0
PICTURES_PROGRAM = """
import resource, sys
import numpy as np
from gigabrain_zenoh.host import this_process as heap

heap.map_large_blocks()


def draw():
    parts = [np.ones(75_000, np.float32) for _ in range(4)]
    del parts


draw()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(100):
    draw()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def grown_mb(*words: str) -> float:
    """Return how much larger a process stays after large arrays in threads [MB]."""
    done = subprocess.run(
        (sys.executable, "-c", MAPS_PROGRAM, *words), capture_output=True, text=True, check=True
    )
    return float(done.stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_large_blocks_go_back_to_the_system() -> None:
    assert grown_mb("mapped") < MAX_GROWTH_MB


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's heap")
def test_memory_needed_for_each_picture_stays_in_the_heap() -> None:
    done = subprocess.run(
        (sys.executable, "-c", PICTURES_PROGRAM), capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 1000


CODE_PROGRAM = """
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.mapping.slam_map import warm_up

def code_kb():
    mapped = 0
    for line in open("/proc/self/smaps"):
        words = line.split()
        if len(words) >= 5 and "-" in words[0]:
            of_file = words[1] == "r-xp" and words[4] != "0"
        elif words[0] == "Rss:" and of_file:
            mapped += int(words[1])
    return mapped

warm_up()
before = code_kb()
this_process.unmap_code()
warm_up()
print(before, code_kb())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="Linux tells what is mapped")
def test_code_used_only_at_the_start_is_unmapped() -> None:
    pytest.importorskip("gtsam")
    done = subprocess.run((sys.executable, "-c", CODE_PROGRAM), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    before, after = map(int, done.stdout.split())
    assert after < before - 15_000
