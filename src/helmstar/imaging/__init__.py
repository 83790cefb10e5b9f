"""Floor 1: cameras, star images and what is seen in them. NumPy and SciPy; no JAX."""

from .camera import Camera, read_camera, write_camera
from .frame import Centroids, Image

__all__ = ["Camera", "Centroids", "Image", "read_camera", "write_camera"]
