"""Why a problem has no attitude, and a front that refuses it by name.

Inside jit nothing can be raised: the solvers return observable = False with NaN for the attitude. `why_unobservable` gives the
reason as a number there too. Outside, `check_directions` and `solve` raise. Neither can see two stars whose identities are
swapped: without a prior that is another good attitude.
"""

from __future__ import annotations

from enum import IntEnum
from types import ModuleType
from typing import Any

import numpy as np

from ..errors import DataError
from . import components as c
from . import optimum as o
from .wahba import OBSERVABLE_SINE, accept, namespace, real_type, threshold


class Reason(IntEnum):
    """What `why_unobservable` answers; the first that holds."""

    OBSERVABLE = 0
    NOT_FINITE = 1
    NO_LENGTH = 2
    BAD_WEIGHT = 3
    TOO_FEW = 4
    ONE_WEIGHT = 5
    PARALLEL_IN_B = 6
    PARALLEL_IN_N = 7
    AMBIGUOUS = 8


TEXTS = {
    Reason.NOT_FINITE: "a direction is NaN or infinite",
    Reason.NO_LENGTH: "a direction has no length, or one whose square is not a number of this precision",
    Reason.BAD_WEIGHT: "a sigma is not a positive number, or a weight is negative, NaN or infinite",
    Reason.TOO_FEW: "fewer than two directions are present",
    Reason.ONE_WEIGHT: "the weights leave one direction: the others count for nothing beside it",
    Reason.PARALLEL_IN_B: "all directions in B lie on one line (equal or opposite)",
    Reason.PARALLEL_IN_N: "all directions in N lie on one line (equal or opposite)",
    Reason.AMBIGUOUS: "more than one attitude fits equally well, the directions in B and in N contradict each other",
}


class DirectionsError(DataError, ValueError):
    """Directions that do not fix an attitude; the message names the problem's index, the directions and the reason."""


def why_unobservable(b: Any, r: Any, sigma: Any = None, mask: Any = None, weights: Any = None) -> Any:
    """Reason (...,) as an integer, 0 where the attitude is observable. Arguments as for `davenport`; also inside jit."""
    xp = namespace(b, r, sigma, mask, weights)
    with np.errstate(all="ignore"):
        return _reason(b, r, sigma, mask, weights, xp)


def _reason(b: Any, r: Any, sigma: Any, mask: Any, weights: Any, xp: ModuleType) -> Any:
    faults = _faults(b, r, sigma, mask, weights, xp)
    d = c.directions(xp, b, r, sigma, mask, weights)
    _, _, a, present = accept(b, r, sigma, mask, weights, xp)
    counting = [xp.where(a[..., i] > 0, xp.ones_like(d.total), xp.zeros_like(d.total)) for i in range(a.shape[-1])]
    limit = threshold(d.dtype)

    def spread(w: list[Any], v: list[c.Vector]) -> Any:
        _, det, second = c.information(w, v)
        return (det > limit * second) & (second > 0)

    number = c.total(counting)
    equal = [x / number for x in counting]
    alone = (xp.sum(present, axis=-1) >= 2) & (number < 2)
    answer = xp.where(c.observable(d, _gap(d)), Reason.OBSERVABLE, Reason.AMBIGUOUS)
    # The first that holds is put last.
    in_b, in_n = spread(d.w, d.b), spread(d.w, d.r)
    answer = xp.where(in_n, answer, Reason.PARALLEL_IN_N)
    answer = xp.where(in_b, answer, Reason.PARALLEL_IN_B)
    heavy = alone | (spread(equal, d.b) & spread(equal, d.r) & ~(in_b & in_n))
    answer = xp.where(heavy, Reason.ONE_WEIGHT, answer)
    answer = xp.where(xp.sum(present, axis=-1) < 2, Reason.TOO_FEW, answer)
    for reason in (Reason.BAD_WEIGHT, Reason.NO_LENGTH, Reason.NOT_FINITE):
        answer = xp.where(xp.any(faults[reason], axis=-1), reason, answer)
    return answer


def _faults(b: Any, r: Any, sigma: Any, mask: Any, weights: Any, xp: ModuleType) -> dict[Reason, Any]:
    """For each reason that concerns one direction: where it holds, (..., n)."""
    b, r, a, mask = accept(b, r, sigma, mask, weights, xp)
    finite = xp.all(xp.isfinite(b), axis=-1) & xp.all(xp.isfinite(r), axis=-1)
    square_b, square_r = (xp.sum(v * v, axis=-1) for v in (b, r))
    tiny = float(np.finfo(a.dtype).tiny)
    length = (square_b >= tiny) & (square_r >= tiny) & (square_b < np.inf) & (square_r < np.inf)
    return {
        Reason.NOT_FINITE: mask & ~finite,
        Reason.NO_LENGTH: mask & finite & ~length,
        Reason.BAD_WEIGHT: mask & ~(a < np.inf),
    }


def _gap(d: c.Directions) -> Any:
    """Distance of K's two largest eigenvalues."""
    polynomial = o.characteristic(c.profile(d), d)
    return polynomial.gap(polynomial.newton(d.xp.ones_like(polynomial.size), 1 + o.NEWTON_STEPS))


def check_directions(b: Any, r: Any, sigma: Any = None, mask: Any = None, weights: Any = None) -> None:
    """Raises DirectionsError (a DataError and a ValueError) if any problem has no attitude, naming the first; ValueError for
    shapes that do not fit; TypeError inside jit. Arguments as for `davenport`."""
    try:
        b, r, sigma, mask, weights = (None if v is None else np.asarray(v) for v in (b, r, sigma, mask, weights))
    except TypeError as error:
        if "racer" not in f"{type(error).__name__}{error}":
            raise
        raise TypeError("directions inside jit cannot be checked: call the solver and look at observable") from None
    reasons = np.atleast_1d(why_unobservable(b, r, sigma, mask, weights))
    bad = np.argwhere(reasons != Reason.OBSERVABLE)
    if not len(bad):
        return
    index = tuple(int(i) for i in bad[0])
    reason = Reason(int(reasons[index]))
    text = TEXTS[reason]
    faults = _faults(b, r, sigma, mask, weights, np)
    if reason in faults:
        here = np.broadcast_to(faults[reason], (*reasons.shape, b.shape[-2]))[index]
        text += f": direction {', '.join(str(i) for i in np.flatnonzero(here))}"
    elif reason in (Reason.PARALLEL_IN_B, Reason.PARALLEL_IN_N):
        # The share of the weight that is across the line is a quarter of the square of two directions' separation.
        limit = max(2.0 * OBSERVABLE_SINE, 2.0 * float(np.sqrt(threshold(real_type(b, r)))))
        text += f" within some {limit:.0e} rad"
    where = f"problem {index[0] if len(index) == 1 else index}" if reasons.size > 1 else "the problem"
    more = f"; {len(bad) - 1} more of {reasons.size} have no attitude either" if len(bad) > 1 else ""
    raise DirectionsError(f"{where}: {text}{more}")
