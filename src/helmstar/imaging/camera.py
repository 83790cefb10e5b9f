"""The camera of a star tracker: pinhole, pixels that need not be square, Brown-Conrady distortion.

S is the sensor's frame: z along the boresight, x to the right (columns), y down (rows). A pixel's centre has integer
coordinates, as in an array and in OpenCV, so an image of width W reaches from -1/2 to W - 1/2 and its geometric centre is
(W - 1)/2. With a = aspect (pixel height over width) and f = focal_px, a direction [X, Y, Z] in S is seen at

    x = X/Z, y = Y/Z, r^2 = x^2 + y^2, g = 1 + k1 r^2 + k2 r^4 + k3 r^6
    x' = x g + 2 p1 x y + p2 (r^2 + 2 x^2),    y' = y g + p1 (r^2 + 2 y^2) + 2 p2 x y
    u = cx + f x',    v = cy + f y' / a

so that without distortion the direction of a pixel is along [(u - cx)/f, a (v - cy)/f, 1].
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ..distortion import distort, reach, undistort, undistort_one
from ..errors import ConfigurationError
from ..files import write_atomically

MAX_SIDE_PX = 100_000
_TABLE = "camera"


@dataclass(frozen=True)
class Camera:
    """width, height: px. focal_px: focal length in pixel widths. centre_px: where the boresight is seen (column, row), px;
    None is the geometric centre. aspect: pixel height over width. distortion: (k1, k2, p1, p2, k3), OpenCV's order.

    Raises ValueError for what is no camera, and for a distortion that folds the image over within its corners.
    """

    width: int
    height: int
    focal_px: float
    centre_px: tuple[float, float] | None = None
    aspect: float = 1.0
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if isinstance(value, bool) or int(value) != value or not 1 <= value <= MAX_SIDE_PX:
                raise ValueError(f"{name} {value}: must be a whole number of pixels, 1 to {MAX_SIDE_PX}")
            object.__setattr__(self, name, int(value))
        if not (math.isfinite(self.focal_px) and self.focal_px > 0.0):
            raise ValueError(f"focal_px {self.focal_px}: must be a positive number of pixels")
        if not (math.isfinite(self.aspect) and 0.1 <= self.aspect <= 10.0):
            raise ValueError(f"aspect {self.aspect}: pixel height over width must be 0.1 to 10")
        centre = self.centre_px
        if centre is None:
            centre = ((self.width - 1) / 2, (self.height - 1) / 2)
        centre, distortion = tuple(map(float, centre)), tuple(map(float, self.distortion))
        if len(centre) != 2 or not all(map(math.isfinite, centre)):
            raise ValueError(f"centre_px {self.centre_px}: must be column and row, two numbers")
        if len(distortion) != 5 or not all(map(math.isfinite, distortion)):
            raise ValueError(f"distortion {self.distortion}: must be five numbers, k1, k2, p1, p2, k3")
        object.__setattr__(self, "focal_px", float(self.focal_px))
        object.__setattr__(self, "aspect", float(self.aspect))
        object.__setattr__(self, "centre_px", centre)
        object.__setattr__(self, "distortion", distortion)
        if any(distortion) and self._folds():
            raise ValueError(f"distortion {distortion}: folds the image over before its corners; check k1, k2, k3")

    @classmethod
    def from_fov(cls, fov_deg: float, width: int, height: int, aspect: float = 1.0) -> Camera:
        """Without distortion, the boresight in the geometric centre. fov_deg: the horizontal full field, edge to edge.

        Raises ValueError for a field that is not between 0 and 180 deg, and as the class does.
        """
        if not 0.0 < fov_deg < 180.0:
            raise ValueError(f"field of view {fov_deg} deg: must be between 0 and 180")
        return cls(width, height, 0.5 * width / math.tan(math.radians(fov_deg) / 2), aspect=aspect)

    @property
    def cx(self) -> float:
        """Column of the boresight, px."""
        return self.centre_px[0]  # set by __post_init__  # type: ignore[index]

    @property
    def cy(self) -> float:
        """Row of the boresight, px."""
        return self.centre_px[1]  # set by __post_init__  # type: ignore[index]

    @property
    def fov(self) -> float:
        """Horizontal full field between the middles of the left and the right edge, rad."""
        left, right = self.directions(
            np.array([[-0.5, (self.height - 1) / 2], [self.width - 0.5, (self.height - 1) / 2]])
        )
        return float(np.arctan2(np.linalg.norm(np.cross(left, right)), left @ right))

    @property
    def geometric_centre_px(self) -> tuple[float, float]:
        """The middle of the image (column, row), px: ((width - 1)/2, (height - 1)/2)."""
        return (self.width - 1) / 2, (self.height - 1) / 2

    def directions(self, xy_px: np.ndarray) -> np.ndarray:
        """Unit directions in S (..., 3) of pixel positions (..., 2), px; NaN where the distortion has no inverse."""
        xy = self._plane(np.asarray(xy_px, float))
        d = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
        return d / np.linalg.norm(d, axis=-1, keepdims=True)

    def pixels(self, directions_S: np.ndarray) -> np.ndarray:
        """Pixel positions (..., 2), px, of directions in S (..., 3) of any length, inside the image or not.

        NaN for directions behind the camera and beyond the angle at which the distortion folds over.
        """
        d = np.asarray(directions_S, float)
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = np.where(d[..., 2:] > 0.0, d[..., :2] / d[..., 2:], np.nan)
        xy = np.where(np.sum(xy**2, axis=-1, keepdims=True) <= self._reach**2, xy, np.nan)
        xd, yd = self.distort(xy[..., 0], xy[..., 1])[:2]
        return np.stack([self.cx + self.focal_px * xd, self.cy + self.focal_px / self.aspect * yd], axis=-1)

    def inside(self, xy_px: np.ndarray, margin_px: float = 0.0) -> np.ndarray:
        """Which positions (..., 2) lie on the image, at least a margin from its edges; bool (...)."""
        x, y = xy_px[..., 0], xy_px[..., 1]
        m = margin_px - 0.5
        return (x >= m) & (y >= m) & (x <= self.width - 1 - m) & (y <= self.height - 1 - m)

    def pixel_covariance(self, xy_px: np.ndarray, covariance_px: np.ndarray) -> np.ndarray:
        """Covariance (n, 2, 2), rad^2, of the tangent-plane position (x, y) of S for pixel positions (n, 2) with (n, 2, 2)."""
        xy = self._plane(np.asarray(xy_px, float))
        _, _, a, b, c, d = self.distort(xy[..., 0], xy[..., 1])
        scale = np.array([self.focal_px, self.focal_px / self.aspect])
        J = np.stack([np.stack([a, b], -1), np.stack([c, d], -1)], -2) * scale[:, None]
        inverse = np.linalg.inv(J)
        return inverse @ covariance_px @ np.swapaxes(inverse, -1, -2)

    @property
    def _reach(self) -> float:
        """The radius sqrt(x^2 + y^2) up to which the radial distortion grows; infinite for most lenses."""
        return reach(self.distortion)

    def _folds(self) -> bool:
        """Whether a corner lies beyond what the distortion reaches."""
        k1, k2, p1, p2, k3 = self.distortion
        columns, rows = (-0.5, self.width - 0.5), (-0.5, self.height - 0.5)
        x, y = max(abs(u - self.cx) for u in columns), max(abs(v - self.cy) for v in rows)
        corner = math.hypot(x, self.aspect * y) / self.focal_px
        # Most lenses bend little: where, within twice the corner's radius, the derivatives are within a quarter of the identity,
        # what is seen at a corner is a fixed point of a contraction, and Newton's method converges (Kantorovich).
        r = 2.0 * corner
        if 6 * r * (abs(p1) + abs(p2)) + r**2 * (3 * abs(k1) + r**2 * (5 * abs(k2) + r**2 * 7 * abs(k3))) < 0.25:
            return False
        if p1 or p2:
            return any(math.isnan(self.plane(u, v)[0]) for u in columns for v in rows)
        r = self._reach
        if math.isinf(r):
            return False
        return corner > r * (1 + r**2 * (k1 + r**2 * (k2 + r**2 * k3)))

    def distort(self, x: Any, y: Any) -> tuple[Any, ...]:
        """Of arrays or numbers x, y: x', y' and the derivatives dx'/dx, dx'/dy, dy'/dx, dy'/dy."""
        return distort(x, y, self.distortion)

    def plane(self, u: float, v: float) -> tuple[float, float]:
        """X/Z and Y/Z of the direction that is seen at one pixel, as `directions` in plain numbers; NaN where there is none."""
        xd, yd = (u - self.cx) / self.focal_px, (v - self.cy) * (self.aspect / self.focal_px)
        if not any(self.distortion):
            return xd, yd
        return undistort_one(xd, yd, self.distortion, self._reach)

    def _plane(self, xy_px: np.ndarray) -> np.ndarray:
        """x, y on the plane Z = 1 (..., 2); NaN where the distortion has no inverse."""
        xd = (xy_px[..., 0] - self.cx) / self.focal_px
        yd = (xy_px[..., 1] - self.cy) * (self.aspect / self.focal_px)
        if not any(self.distortion):
            return np.stack([xd, yd], axis=-1)
        return np.stack(undistort(xd, yd, self.distortion), axis=-1)

    def to_toml(self) -> str:
        """The camera as the text of a cam.toml; numbers come back bit for bit."""
        lines = [f"[{_TABLE}]", f"width = {self.width}", f"height = {self.height}", f"focal_px = {self.focal_px!r}"]
        lines += [f"centre_px = [{self.cx!r}, {self.cy!r}]", f"aspect = {self.aspect!r}"]
        lines += [f"distortion = [{', '.join(map(repr, self.distortion))}]  # k1, k2, p1, p2, k3"]
        return "\n".join(lines) + "\n"


def write_camera(path: Path, camera: Camera) -> None:
    """Write cam.toml, whole or not at all. Raises OSError."""
    write_atomically(Path(path), camera.to_toml())


def read_camera(path: Path) -> Camera:
    """Read cam.toml: a table [camera] with the fields of `Camera`, or fov_deg (horizontal) instead of focal_px.

    Raises ConfigurationError, naming file and key, for what is not there, no TOML, or no camera.
    """
    path = Path(path)
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as e:
        raise ConfigurationError(
            f"{path}: {e.strerror or e}; give a camera file as `helmstar calibrate` writes"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as e:
        raise ConfigurationError(f"{path}: not a TOML file ({e}); give one with a table [{_TABLE}]") from None
    table = tables.get(_TABLE)
    if not isinstance(table, dict):
        raise ConfigurationError(f"{path}: no table [{_TABLE}]; it holds width, height and focal_px or fov_deg")
    known = {f.name for f in fields(Camera)}
    keys = ", ".join([*sorted(known), "fov_deg"])
    unknown = sorted(set(table) - known - {"fov_deg"})
    if unknown:
        raise ConfigurationError(f"{path}: [{_TABLE}] has the unknown key {unknown[0]!r}; known: {keys}")
    for key in ("width", "height"):
        if key not in table:
            raise ConfigurationError(f"{path}: [{_TABLE}] lacks {key}")
    for key, value in table.items():
        want: Any = ("centre_px", 2) if key == "centre_px" else ("distortion", 5) if key == "distortion" else None
        numbers = value if want else [value]
        if want and not (isinstance(value, list) and len(value) == want[1]):
            raise ConfigurationError(f"{path}: [{_TABLE}] {key} must be {want[1]} numbers, is {value!r}")
        if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in numbers):
            raise ConfigurationError(f"{path}: [{_TABLE}] {key} must hold numbers, is {value!r}")
    if ("fov_deg" in table) == ("focal_px" in table):
        raise ConfigurationError(f"{path}: [{_TABLE}] needs focal_px or fov_deg, one of the two")
    table = dict(table)
    try:
        if "fov_deg" in table:
            table["focal_px"] = Camera.from_fov(table.pop("fov_deg"), table["width"], table["height"]).focal_px
        for key in ("centre_px", "distortion"):
            if key in table:
                table[key] = tuple(table[key])
        return Camera(**table)
    except (ValueError, OverflowError) as e:
        raise ConfigurationError(f"{path}: [{_TABLE}] {e}") from None


__all__ = ["Camera", "read_camera", "write_camera"]
