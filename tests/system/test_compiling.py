"""Kernels are compiled in advance, in a child process."""

import asyncio
import os
import subprocess
import sys
import types
from importlib.util import find_spec
from pathlib import Path

import pytest

pytest.importorskip("numba")

from gigabrain_zenoh.cli import map as map_commands
from gigabrain_zenoh.decision.drive_kernels import ARM_KERNELS, CAR_KERNELS, DRIVE_KERNELS
from gigabrain_zenoh.errors import ConfigError, GigabrainError
from gigabrain_zenoh.kernels import cache as kernels
from gigabrain_zenoh.kernels import jit, precompile
from gigabrain_zenoh.perception.node import LOCALIZE_KERNELS, MAP_KERNELS
from gigabrain_zenoh.plugins import find
from tests.places import ROOT

COUNTED_MODULE = """
import os
def warm_up():
    with open(os.environ["CALLS"], "a") as file:
        print(os.getpid(), file=file)
"""
WARM_UP = "counted:warm_up"
WARM_UPS = (MAP_KERNELS, LOCALIZE_KERNELS, DRIVE_KERNELS, CAR_KERNELS, ARM_KERNELS)


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file to which each call of `warm_up` appends its process's pid."""
    (tmp_path / "counted.py").write_text(COUNTED_MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("CALLS", str(tmp_path / "calls"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
    monkeypatch.delitem(sys.modules, "counted", raising=False)
    return tmp_path / "calls"


def calls_by_this_process(calls: Path) -> list[bool]:
    """Return for each call whether this process made it."""
    return [int(line) == os.getpid() for line in calls.read_text().split()]


async def test_the_first_start_compiles_in_a_child_process(calls: Path) -> None:
    await precompile.ensure_compiled(WARM_UP)
    assert calls_by_this_process(calls) == [False, True]
    await precompile.ensure_compiled(WARM_UP)
    assert calls_by_this_process(calls) == [False, True, True]


async def test_after_a_change_of_any_kernel_a_child_compiles_again(
    calls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    await precompile.ensure_compiled(WARM_UP)
    monkeypatch.setattr(kernels, "PACKAGE", tmp_path)
    await precompile.ensure_compiled(WARM_UP)
    assert calls_by_this_process(calls) == [False, True, False, True]


async def test_without_a_cache_folder_this_process_compiles(
    calls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "below"))
    await precompile.ensure_compiled(WARM_UP)
    assert calls_by_this_process(calls) == [True]


TINY_MODULE = """
from gigabrain_zenoh.kernels.jit import kernel
@kernel
def double(x: int) -> int:
    return 2 * x
def warm_up() -> None:
    assert double(21) == 42
"""
ON_FULL_DISK = """
import asyncio, errno, os
from gigabrain_zenoh.kernels import jit, precompile
from numba.core.caching import IndexDataCacheFile
def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
IndexDataCacheFile._save_data = full  # the smaller mark still fits
async def in_child(*_):
    return 1
precompile.compile_in_child = in_child
asyncio.run(precompile.ensure_compiled("tiny:warm_up"))
print(precompile.is_kept("tiny:warm_up"))
precompile.compile_all("tiny:warm_up")
print(precompile.is_kept("tiny:warm_up"))
"""


def test_on_a_full_disk_kernels_run_but_do_not_count_as_cached(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tiny.py").write_text(TINY_MODULE)
    places = (str(tmp_path), str(ROOT), os.environ.get("PYTHONPATH", ""))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(places))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
    done = subprocess.run((sys.executable, "-c", ON_FULL_DISK), capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "False\nFalse\n"), done.stderr


async def test_precompile_fails_if_the_kernels_cannot_be_cached(
    calls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    folder = tmp_path / "file" / "below"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder))
    fault = f"compiled, but not kept: cannot write {folder}; make room there, or "
    fault += "name another folder with NUMBA_CACHE_DIR"
    with pytest.raises(ConfigError, match=f"^mapping: {fault}$"):
        await map_commands._compile("mapping", WARM_UP, links=True)


async def test_precompile_says_that_sources_changed_while_they_were_compiled(
    calls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "package" / "mapping" / "grid.py"
    source.parent.mkdir(parents=True)
    source.write_text("")
    monkeypatch.setattr(kernels, "PACKAGE", tmp_path / "package")

    async def in_child(_: str) -> int:
        source.write_text("CELLS = 2\n")
        return 0

    monkeypatch.setattr(precompile, "compile_in_child", in_child)
    fault = "sources changed while they were compiled; run `gigabrain precompile` again"
    with pytest.raises(GigabrainError, match=f"^mapping: {fault}$"):
        await map_commands._compile("mapping", WARM_UP, links=True)


def test_precompiling_leaves_a_mark_for_the_next_start(calls: Path) -> None:
    mark = kernels.mark_of(WARM_UP)
    assert mark
    assert not mark.exists()
    precompile.compile_all(WARM_UP)
    assert mark.exists()


@pytest.mark.parametrize("warm_up", WARM_UPS)
def test_every_warm_up_function_exists(warm_up: str) -> None:
    assert isinstance(find(warm_up), types.FunctionType)


@pytest.mark.parametrize("code", [0, 1])
def test_precompile_compiles_the_kernels_of_each_process(
    code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tried, done = list[str](), list[str]()

    async def in_child(warm_up: str) -> int:
        tried.append(warm_up)
        return code

    monkeypatch.setattr(precompile, "compile_in_child", in_child)
    monkeypatch.setattr(precompile, "compile_all", done.append)
    monkeypatch.setattr(precompile, "is_kept", lambda _: True)
    monkeypatch.setattr(precompile, "can_link", lambda: False)
    map_commands.precompile()
    assert sorted(tried) == sorted(WARM_UPS)
    assert done == (tried if code else [])  # this process does what the child could not
    out = capsys.readouterr().out
    assert out.count(" s\n") == 2
    assert map_commands.NOT_LINKED in out


async def test_precompile_links_the_kernels_of_each_process(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    linked = dict[str, tuple[str, ...]]()

    async def in_child(*_: str) -> int:
        return 0

    async def link(library: str, *warm_ups: str) -> int:
        linked[library] = warm_ups
        return 0

    monkeypatch.setattr(precompile, "can_link", lambda: True)
    monkeypatch.setattr(precompile, "compile_in_child", in_child)
    monkeypatch.setattr(precompile, "is_kept", lambda _: True)
    monkeypatch.setattr(precompile, "link_in_child", link)
    await map_commands._compile_all()
    assert set(linked) == {"mapping", "driving"}
    assert sorted(one for some in linked.values() for one in some) == sorted(WARM_UPS)
    assert "not linked" not in capsys.readouterr().out


def test_a_failing_child_has_a_nonzero_exit_code(calls: Path) -> None:
    assert asyncio.run(precompile.compile_in_child(WARM_UP)) == 0
    assert calls_by_this_process(calls) == [False]
    assert asyncio.run(precompile.compile_in_child("counted:nothing")) == 1


IMPORTS_BY_NUMBA = """
import importlib, sys
from gigabrain_zenoh.kernels import jit as kernels
@kernels.kernel
def double(x):
    return 2 * x
double(21)
print(*(name for name in sys.argv[1:] if name in sys.modules))
for name in sys.argv[1:]:
    importlib.import_module(name)
"""


def test_numba_imports_no_unused_package_and_these_stay_importable() -> None:
    installed = [name for name in jit.UNUSED if find_spec(name.partition(".")[0])]
    assert "coverage" in installed
    command = (sys.executable, "-c", IMPORTS_BY_NUMBA, *installed)
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "\n"), done.stderr


LOCALIZE_ONLY = """
import sys
import gigabrain_zenoh.perception.mapper
from gigabrain_zenoh.mapping.static_map import warm_up
warm_up()
print("gtsam" in sys.modules)
"""


def test_localizing_in_a_saved_map_does_not_import_gtsam() -> None:
    done = subprocess.run((sys.executable, "-c", LOCALIZE_ONLY), capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr


def test_the_child_imports_nothing_from_the_current_folder(
    calls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    for name in ("msgspec", "signal", "gigabrain_schemas"):
        (here / f"{name}.py").write_text(f"open({str(here / 'was_run')!r}, 'w')\n")
    monkeypatch.chdir(here)
    assert asyncio.run(precompile.compile_in_child(WARM_UP)) == 0
    assert not (here / "was_run").exists()
    assert calls_by_this_process(calls) == [False]


def test_the_error_of_a_failing_child_is_logged(
    calls: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert asyncio.run(precompile.compile_in_child("counted:nothing")) == 1
    (logged,) = (
        record.getMessage() for record in caplog.records if "compil" in record.getMessage()
    )
    assert logged.endswith("AttributeError: module 'counted' has no attribute 'nothing'")
