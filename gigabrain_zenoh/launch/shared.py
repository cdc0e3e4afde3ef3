"""Imported by a fork server: its forks share what each of them would load."""

import numpy.ma  # noqa: F401 - np.unique loads it, 9 MB

import gigabrain_zenoh.launch.processes  # noqa: F401
from gigabrain_zenoh.launch.process import loop_factory
from gigabrain_zenoh.plugins import offered, package_version

loop_factory()
package_version()
offered("")  # finds what all packages offer
