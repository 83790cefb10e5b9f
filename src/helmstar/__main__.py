"""`python -m helmstar`."""

from .cli import entry

entry()
