"""Imported by a fork server, so that its forks share the memory of these imports."""

import numpy.ma  # noqa: F401 - np.unique loads it, 9 MB

import gigabrain_zenoh.launch.processes  # noqa: F401
from gigabrain_zenoh.launch.process import loop_factory
from gigabrain_zenoh.plugins import offered, package_version

loop_factory()
package_version()
offered("")  # caches the entry points of all packages
