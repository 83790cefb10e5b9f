"""Shared by all tests: hypothesis is deterministic and never timed, so that a run can be repeated."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("helmstar", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("helmstar")

SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real data beside the checkout; a test that needs it says so when it is absent."""
    if not SHARED.is_dir():
        pytest.skip(f"the real data are not beside the checkout ({SHARED}): this test did not run")
    return SHARED
