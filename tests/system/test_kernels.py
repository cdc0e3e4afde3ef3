"""Cache folders of compiled functions."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gigabrain_zenoh.testing.processes import SOURCES

pytest.importorskip("numba")

from gigabrain_zenoh.kernels import cache as kernels


def test_a_change_in_any_source_with_kernels_gets_a_new_cache_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(kernels, "PACKAGE", tmp_path)
    (tmp_path / "mapping").mkdir()
    (tmp_path / "mapping" / "one.py").write_text("x = 1")
    first = kernels.cache_folder()
    assert first is not None
    assert first.parent == tmp_path / "gigabrain"
    assert kernels.cache_folder() == first
    (tmp_path / "mapping" / "one.py").write_text("x = 2")
    kernels.digest.cache_clear()  # as in a new process
    assert kernels.cache_folder() != first


def test_a_second_checkout_does_not_count_as_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folders = []
    for name in ("one", "other"):
        monkeypatch.setattr(kernels, "PACKAGE", tmp_path / name)
        source = tmp_path / name / "mapping" / "one.py"
        source.parent.mkdir(parents=True)
        source.write_text("x = 1")
        os.utime(source, (1, 1))
        folders.append(kernels.cache_folder())
    os.utime(source, (2, 2))  # another file for numba
    kernels.digest.cache_clear()
    assert len({*folders, kernels.cache_folder()}) == 3


def test_without_a_writable_cache_kernels_are_still_compiled(tmp_path: Path) -> None:
    no_folder = tmp_path / "file"
    no_folder.write_text("")
    environment = {
        "PYTHONPATH": ":".join(map(str, SOURCES)),
        "NUMBA_CACHE_DIR": str(no_folder / "below"),
    }
    code = (
        "from gigabrain_zenoh.kernels.jit import kernel\n"
        "@kernel\ndef double(x: int) -> int:\n    return 2 * x\n"
        "print(double(21))"
    )
    source = tmp_path / "run.py"
    source.write_text(code)
    done = subprocess.run(
        (sys.executable, str(source)), capture_output=True, text=True, env=environment
    )
    assert done.stdout == "42\n", done.stderr
