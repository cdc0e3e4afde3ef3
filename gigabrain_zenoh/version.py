"""The version, read from the installed package only when somebody asks."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("gigabrain-zenoh")
except PackageNotFoundError:  # a checkout that was never installed
    __version__ = "0+unknown"
