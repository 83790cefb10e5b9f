"""Floor 1: cameras, star images and what is seen in them. NumPy and SciPy; no JAX.

`calibrate` and `render` are modules to import: they load more of SciPy than solving needs.
"""

from .camera import Camera, read_camera, write_camera
from .detect import DetectionSettings, dark_of, detect
from .frame import Centroids, Image

__all__ = ["Camera", "Centroids", "DetectionSettings", "Image", "dark_of", "detect", "read_camera", "write_camera"]
