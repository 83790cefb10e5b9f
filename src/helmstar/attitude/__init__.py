"""Floor 1: Wahba's problem, the attitude from directions. For NumPy or JAX arrays; with NumPy no JAX is imported."""

from .wahba import WahbaSolution, davenport, svd

__all__ = ["WahbaSolution", "davenport", "svd"]
