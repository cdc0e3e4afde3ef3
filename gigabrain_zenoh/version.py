"""Version of the installed package; imported only where it is needed."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("gigabrain-zenoh")
except PackageNotFoundError:  # a checkout without an installation
    __version__ = "0+unknown"
