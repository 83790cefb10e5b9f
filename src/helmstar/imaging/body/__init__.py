"""A target body in a frame: its figure and light, rendering, and its centre with a covariance. NumPy and SciPy; no JAX.

`phase`, `raycast`, `raster`, `measurement` and `mesh_files` are modules to import.
"""

from .moment import brightness_centroid, centre_from_moment, centre_of_figure, preprocess, windowed_centroid
from .photometry import LAWS, Hapke, Lambert, Law, LommelSeeliger, McEwen, Minnaert, law_of
from .render_body import BodyTruth, Stars, render_body, render_window
from .shape import Ellipsoid, Mesh, Shape, sphere
from .target import Detector, FigureCentre, Pose, Target

__all__ = [
    "LAWS", "BodyTruth", "Detector", "Ellipsoid", "FigureCentre", "Hapke", "Lambert", "Law", "LommelSeeliger", "McEwen", "Mesh",
    "Minnaert", "Pose", "Shape", "Stars", "Target", "brightness_centroid", "centre_from_moment", "centre_of_figure", "law_of",
    "preprocess", "render_body", "render_window", "sphere", "windowed_centroid",
]  # fmt: skip
