"""Floor 1: Wahba's problem, the attitude from directions. For NumPy or JAX arrays; with NumPy no JAX is imported.

All solvers have one signature, (b, r, sigma, mask, weights), and return a `WahbaSolution`; which to take stands in
docs/attitude-solvers.md. `solve` is the front that refuses what has no attitude.
"""

from typing import Any

from .check import DirectionsError, Reason, check_directions, why_unobservable
from .continuity import continue_sign, continuous, nearest_sign, propagate
from .decompositions import davenport, svd
from .esoq import esoq, esoq2
from .foam import foam
from .olae import olae
from .quest import quest, quest_two
from .triad import triad, triad_optimised
from .wahba import WahbaSolution, quaternion_of_matrix

SOLVERS = {f.__name__: f for f in (triad, triad_optimised, davenport, svd, quest, quest_two, foam, esoq, esoq2, olae)}
"""Name to solver; `quest_two` takes two directions, the others any number."""


def solve(
    method: str,
    b: Any,
    r: Any,
    sigma: Any = None,
    mask: Any = None,
    weights: Any = None,
    *,
    check: bool = True,
) -> WahbaSolution:
    """The solver of that name; other arguments as for `davenport`.

    With check (outside jit) raises DirectionsError for what has no attitude, saying which problem and why. Raises ValueError
    for an unknown method and for shapes that do not fit.
    """
    if method not in SOLVERS:
        raise ValueError(f"method {method!r}: must be one of {', '.join(SOLVERS)}")
    if check:
        check_directions(b, r, sigma, mask, weights)
    return SOLVERS[method](b, r, sigma, mask, weights)


__all__ = [
    "SOLVERS",
    "DirectionsError",
    "Reason",
    "WahbaSolution",
    "check_directions",
    "continue_sign",
    "continuous",
    "davenport",
    "esoq",
    "esoq2",
    "foam",
    "nearest_sign",
    "olae",
    "propagate",
    "quaternion_of_matrix",
    "quest",
    "quest_two",
    "solve",
    "svd",
    "triad",
    "triad_optimised",
    "why_unobservable",
]
