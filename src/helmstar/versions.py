"""Versions that results depend on, for reports and results."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

from . import __version__
from .native import kernels

PACKAGES = ("helmstar", "jax", "jaxlib", "numpy", "scipy", "xarray", "pandas", "plotly", "pydantic")


def versions() -> dict[str, str]:
    """Of Python, the machine and the packages that results depend on."""
    out = {"python": platform.python_version(), "machine": platform.machine(), "system": platform.system()}
    for package in PACKAGES:
        try:
            out[package] = version(package)
        except PackageNotFoundError:
            out[package] = "not installed"
    return out | {"helmstar": __version__, "kernels": "NumPy" if kernels() is None else "compiled"}
