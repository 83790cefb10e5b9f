"""Floor 2: consistency tests, bounds, convergence counts and paired comparisons, in NumPy and SciPy; no JAX."""

from .bounds import Farrenkopf, farrenkopf, recursive_bound, steady_state_variance
from .consistency import chi_square_band, correlation_factor, quadratic_form
from .convergence import Arrival, arrival, diverged
from .paired import PairedDifference, paired_difference

__all__ = [
    "Arrival",
    "Farrenkopf",
    "PairedDifference",
    "arrival",
    "chi_square_band",
    "correlation_factor",
    "diverged",
    "farrenkopf",
    "paired_difference",
    "quadratic_form",
    "recursive_bound",
    "steady_state_variance",
]
