"""Floor 2: the star catalogue, and which stars an image shows: lost in space (`identify`) and near a prior (`track`).

For lists of centroids as plain arrays; docs/stars.md says how it works. No JAX is imported.
"""

from .catalog import Catalog, load_catalog
from .doubt import Doubted, identify_uncalibrated
from .identify import Identification, default_sky, identify
from .patterns import Sky
from .photometry import Photometry, calibrate_photometry
from .pinhole import Camera, Pinhole
from .track import track

__all__ = [
    "Camera",
    "Catalog",
    "Doubted",
    "Identification",
    "Photometry",
    "Pinhole",
    "Sky",
    "calibrate_photometry",
    "default_sky",
    "identify",
    "identify_uncalibrated",
    "load_catalog",
    "track",
]
