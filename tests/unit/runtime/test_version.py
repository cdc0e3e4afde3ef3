"""A description of a process costs little, however often it is asked for."""

import importlib.metadata

import pytest

from gigabrain_zenoh import plugins


def test_the_version_is_read_once_per_process(monkeypatch: pytest.MonkeyPatch) -> None:
    first = plugins.package_version()

    def fail(name: str) -> str:
        raise AssertionError(f"the metadata of {name} was read again")

    monkeypatch.setattr(importlib.metadata, "version", fail)
    assert plugins.package_version() == first
