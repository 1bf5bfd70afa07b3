"""The version of the installed package."""

from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as _installed

try:
    __version__ = _installed("dase")
except PackageNotFoundError:  # a checkout on the path, not installed
    __version__ = "0+unknown"
