"""Floor 0: rotations, quaternions, retractions and small symmetric matrices, for JAX arrays of any batch shape."""

from . import quaternion, small, so3
from .retraction import (
    Retraction,
    euclidean,
    gibbs_left,
    mrp_left,
    product,
    quaternion_additive,
    so3_left,
    so3_right,
    vector_part_left,
)

__all__ = [
    "Retraction",
    "euclidean",
    "gibbs_left",
    "mrp_left",
    "product",
    "quaternion",
    "quaternion_additive",
    "small",
    "so3",
    "so3_left",
    "so3_right",
    "vector_part_left",
]
