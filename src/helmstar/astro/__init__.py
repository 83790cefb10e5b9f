"""Floor 1: orbits. NumPy and SciPy only."""

from .orbit import EARTH, Body, Elements, cartesian, lvlh, propagate

__all__ = ["EARTH", "Body", "Elements", "cartesian", "lvlh", "propagate"]
