"""Floor 5: Monte Carlo campaigns, batched, resumable, the same bits for any split of the work."""

from .runner import Outcome, default_workers, run_campaign

__all__ = ["Outcome", "default_workers", "run_campaign"]
