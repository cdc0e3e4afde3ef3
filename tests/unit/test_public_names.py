"""The public names of `gigabrain_zenoh`, which are imported only when they are used."""

import subprocess
import sys

import gigabrain_zenoh


def test_every_public_name_is_listed_and_documented() -> None:
    assert dir(gigabrain_zenoh) == sorted(gigabrain_zenoh.__all__)
    for name in gigabrain_zenoh.__all__:
        assert getattr(gigabrain_zenoh, name).__doc__


def test_importing_the_package_imports_none_of_it() -> None:
    program = "import gigabrain_zenoh, sys; print('numpy' in sys.modules, 'zenoh' in sys.modules)"
    shown = subprocess.run(
        (sys.executable, "-c", program), capture_output=True, text=True, check=True
    )
    assert shown.stdout.split() == ["False", "False"]
