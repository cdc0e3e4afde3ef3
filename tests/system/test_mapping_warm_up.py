import subprocess
import sys

DRIVE = """
import importlib, pkgutil
from gigabrain_zenoh.kernels.jit import Kernel
from gigabrain_zenoh import mapping
from gigabrain_zenoh.qa.bench.slam_world import map_world
from gigabrain_zenoh.mapping.slam_map import warm_up

def compiled():
    inside = pkgutil.iter_modules(mapping.__path__, mapping.__name__ + ".")
    names = [module.name for module in inside]
    return {
        (function.name, function.overloads)
        for name in names
        for function in vars(importlib.import_module(name)).values()
        if isinstance(function, Kernel) and function.overloads
    }

warm_up()
before = compiled()
map_world("turtlebot3_waffle", "house", 0, 0.5, lambda _: None)
print(len(before), sorted(compiled() - before))
"""


def test_mapping_compiles_nothing_after_its_warm_up() -> None:
    drive = subprocess.run(
        [sys.executable, "-c", DRIVE], capture_output=True, text=True, check=True
    )
    count, late = drive.stdout.split(maxsplit=1)
    assert int(count) > 10
    assert late == "[]\n"
