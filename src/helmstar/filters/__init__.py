"""Floor 2: every filter once, for every model. Variants are retractions."""

from .adaptive import AdaptiveBelief, AdaptiveFilter
from .batch import batch_map, map_estimates
from .ekf import ErrorStateKalmanFilter
from .mixture import MixtureFilter, grid_split, kernel_split, mixture_moments
from .particle import BootstrapFilter, moments, start_particles
from .predictive import PredictiveBelief, PredictiveFilter
from .resampling import draw, effective_number
from .reset import ResettableBelief, ResettingFilter, RestartFromAttitude, RestartFromStars
from .run import Track, run, step
from .smoother import smooth, smooth_step
from .static import StaticSolver, wahba_start
from .ukf import Spread, UnscentedBelief, UnscentedKalmanFilter, kappa_form, scaled
from .unscented import UnscentedParticleFilter, UnscentedParticles, particle_moments, start_unscented_particles

__all__ = [
    "AdaptiveBelief",
    "AdaptiveFilter",
    "BootstrapFilter",
    "ErrorStateKalmanFilter",
    "MixtureFilter",
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
    "UnscentedParticleFilter",
    "UnscentedParticles",
    "batch_map",
    "draw",
    "effective_number",
    "grid_split",
    "kappa_form",
    "kernel_split",
    "map_estimates",
    "mixture_moments",
    "moments",
    "particle_moments",
    "run",
    "scaled",
    "smooth",
    "smooth_step",
    "start_particles",
    "start_unscented_particles",
    "step",
    "wahba_start",
]
