"""Floor 1: Wahba's problem, the attitude from directions. For NumPy or JAX arrays; with NumPy no JAX is imported."""

from .wahba import WahbaSolution, davenport, quaternion_of_matrix, svd

__all__ = ["WahbaSolution", "davenport", "quaternion_of_matrix", "svd"]
