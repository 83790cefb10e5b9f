"""How bright a surface is: laws of reflection r(mu0, mu, alpha), the radiance factor I/F.

mu0 = cosine of incidence, mu = cosine of emission, alpha = phase angle (rad, Sun - surface - camera). I/F = 1 is a white Lambert
surface that faces the Sun. Sources: Lambert; Seeliger (1887); Minnaert (1941); McEwen, "A precise lunar photometric function",
LPSC XXVII (1996), for the polynomial L(alpha); Hapke, "Bidirectional reflectance spectroscopy 1", JGR 86 (1981), eq. 16, with
the two-term Henyey-Greenstein phase function and his rational H(x) = (1 + 2x)/(1 + 2x sqrt(1 - w)), without roughness.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np


class Law(Protocol):
    """A law of reflection. by_phase: whether its pattern over the disc changes with alpha, so that alpha must be given for
    each point."""

    @property
    def by_phase(self) -> bool: ...

    def __call__(self, mu0: np.ndarray, mu: np.ndarray, alpha: np.ndarray | float) -> np.ndarray:
        """I/F (...) for mu0, mu (...) of at least 0 and alpha rad; 0 where mu0 is 0."""
        ...


def _seeliger(mu0: np.ndarray, mu: np.ndarray) -> np.ndarray:
    """2 mu0 / (mu0 + mu): 1 at phase 0."""
    return 2.0 * mu0 / np.maximum(mu0 + mu, 1e-300)


@dataclass(frozen=True)
class Lambert:
    """albedo mu0."""

    albedo: float = 1.0
    by_phase: bool = False

    def __call__(self, mu0: np.ndarray, mu: np.ndarray, alpha: np.ndarray | float) -> np.ndarray:
        return self.albedo * mu0


@dataclass(frozen=True)
class LommelSeeliger:
    """albedo 2 mu0 / (mu0 + mu): single scattering of a dark surface; albedo is I/F at phase 0."""

    albedo: float = 1.0
    by_phase: bool = False

    def __call__(self, mu0: np.ndarray, mu: np.ndarray, alpha: np.ndarray | float) -> np.ndarray:
        return self.albedo * _seeliger(mu0, mu)


@dataclass(frozen=True)
class McEwen:
    """albedo (L 2 mu0/(mu0 + mu) + (1 - L) mu0), L a number or, if None, McEwen's polynomial of the phase, held to 0..1."""

    albedo: float = 1.0
    weight: float | None = None

    @property
    def by_phase(self) -> bool:
        return self.weight is None

    def __call__(self, mu0: np.ndarray, mu: np.ndarray, alpha: np.ndarray | float) -> np.ndarray:
        L = lunar_weight(alpha) if self.weight is None else self.weight
        return self.albedo * (L * _seeliger(mu0, mu) + (1.0 - L) * mu0)


def lunar_weight(alpha: np.ndarray | float) -> np.ndarray:
    """L(alpha) of McEwen (1996): 1 at phase 0, 0.06 at 90 deg, held to 0..1 beyond its range of 130 deg."""
    deg = np.degrees(alpha)
    return np.clip(1.0 + deg * (-0.019 + deg * (2.42e-4 - 1.46e-6 * deg)), 0.0, 1.0)


@dataclass(frozen=True)
class Minnaert:
    """albedo mu0^k mu^(k - 1); k = 1 is Lambert. mu is held to 1e-3, where the law has no limit for k < 1."""

    albedo: float = 1.0
    k: float = 0.7
    by_phase: bool = False

    def __call__(self, mu0: np.ndarray, mu: np.ndarray, alpha: np.ndarray | float) -> np.ndarray:
        return self.albedo * np.maximum(mu0, 0.0) ** self.k * np.maximum(mu, 1e-3) ** (self.k - 1.0)


@dataclass(frozen=True)
class Hapke:
    """w/4 mu0/(mu0 + mu) ((1 + B) P + H(mu0) H(mu) - 1) with B = b0/(1 + tan(alpha/2)/h).

    w: single-scattering albedo, 0..1. b, c: shape and balance of the two-term phase function P. b0, h: opposition surge.
    """

    w: float = 0.3
    b: float = 0.3
    c: float = 0.2
    b0: float = 0.6
    h: float = 0.06
    by_phase: bool = True

    def __post_init__(self) -> None:
        if not (0.0 <= self.w <= 1.0 and 0.0 <= self.b < 1.0 and self.h > 0.0):
            raise ValueError(f"Hapke w {self.w}, b {self.b}, h {self.h}: w must be 0..1, b 0..1 (not 1) and h positive")

    def __call__(self, mu0: np.ndarray, mu: np.ndarray, alpha: np.ndarray | float) -> np.ndarray:
        cos = np.cos(alpha)
        forward = (1.0 - self.b**2) / (1.0 + 2.0 * self.b * cos + self.b**2) ** 1.5
        backward = (1.0 - self.b**2) / (1.0 - 2.0 * self.b * cos + self.b**2) ** 1.5
        P = 0.5 * (1.0 - self.c) * forward + 0.5 * (1.0 + self.c) * backward
        surge = self.b0 / (1.0 + np.tan(0.5 * np.minimum(alpha, 3.14)) / self.h)
        gamma = math.sqrt(1.0 - self.w)
        H0, H = (1 + 2 * mu0) / (1 + 2 * mu0 * gamma), (1 + 2 * mu) / (1 + 2 * mu * gamma)
        return 0.125 * self.w * _seeliger(mu0, mu) * ((1.0 + surge) * P + H0 * H - 1.0)


LAWS: dict[str, Callable[..., Law]] = {
    "lambert": Lambert,
    "lommel_seeliger": LommelSeeliger,
    "mcewen": McEwen,
    "minnaert": Minnaert,
    "hapke": Hapke,
}
"""By the name that configurations use."""


def law_of(name: str, **parameters: float) -> Law:
    """A law by name. Raises ValueError, naming what there is, for another name or another parameter."""
    if name not in LAWS:
        raise ValueError(f"law {name!r}: must be one of {', '.join(LAWS)}")
    try:
        return LAWS[name](**parameters)
    except TypeError:
        raise ValueError(f"law {name!r} does not have all of the parameters {', '.join(parameters)}") from None


def family(mu0: np.ndarray, mu: np.ndarray) -> list[np.ndarray]:
    """Patterns whose sums come near every law above at one phase: what a fit uses where the law is not known.

    Lambert and Lommel-Seeliger are two of the sums; mu0 mu and mu0^2 bend limb and terminator; two of Minnaert's brighten the limb.
    """
    fall = np.sqrt(mu0 / np.maximum(mu, 1e-3))
    return [mu0, _seeliger(mu0, mu), mu0 * mu, mu0 * mu0, fall, np.sqrt(mu0 * fall)]


__all__ = [
    "LAWS", "Hapke", "Lambert", "Law", "LommelSeeliger", "McEwen", "Minnaert", "family", "law_of", "lunar_weight",
]  # fmt: skip
