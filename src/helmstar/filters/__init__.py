"""Floor 2: every filter once, for every model. Variants are retractions."""

from .adaptive import AdaptiveBelief, AdaptiveFilter
from .ekf import ErrorStateKalmanFilter
from .predictive import PredictiveBelief, PredictiveFilter
from .reset import ResettableBelief, ResettingFilter, RestartFromAttitude, RestartFromStars
from .run import Track, run, step
from .smoother import smooth, smooth_step
from .static import StaticSolver, wahba_start
from .ukf import Spread, UnscentedBelief, UnscentedKalmanFilter, kappa_form, scaled

__all__ = [
    "AdaptiveBelief",
    "AdaptiveFilter",
    "ErrorStateKalmanFilter",
    "PredictiveBelief",
    "PredictiveFilter",
    "ResettableBelief",
    "ResettingFilter",
    "RestartFromAttitude",
    "RestartFromStars",
    "Spread",
    "StaticSolver",
    "Track",
    "UnscentedBelief",
    "UnscentedKalmanFilter",
    "kappa_form",
    "run",
    "scaled",
    "smooth",
    "smooth_step",
    "step",
    "wahba_start",
]
