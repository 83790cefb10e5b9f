"""The errors a user can mend: each says what was wrong, where, and what would be right."""


class HelmstarError(Exception):
    """Base of every error that the command line prints without a traceback."""


class ConfigurationError(HelmstarError):
    """A key of a scenario, of sensors.toml or of --set is unknown or its value is not allowed."""


class DataError(HelmstarError):
    """A telemetry file cannot be used; the message names file, row and remedy."""


class CampaignError(HelmstarError):
    """A campaign cannot start or resume as asked."""
