"""The process that turns sensor bytes into a pose for the autopilot."""

from importlib.metadata import version

__version__ = version("companion")
