"""Floor 2: the star catalogue, and which stars an image shows: lost in space (`identify`) and near a prior (`track`).

For lists of centroids as plain arrays; docs/stars.md says how it works. No JAX is imported.
"""

from .catalog import Catalog, load_catalog
from .identify import Identification, default_sky, identify, identify_stated
from .patterns import Sky
from .pinhole import Camera, Pinhole
from .track import track

__all__ = [
    "Camera",
    "Catalog",
    "Identification",
    "Pinhole",
    "Sky",
    "default_sky",
    "identify",
    "identify_stated",
    "load_catalog",
    "track",
]
