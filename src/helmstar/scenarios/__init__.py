"""Floor 4: scenarios as validated files, and the one place where truth, sensors and filters are assembled."""

from .specification import build, library, load, parse_set

__all__ = ["build", "library", "load", "parse_set"]
