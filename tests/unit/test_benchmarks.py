"""The benchmarks compare like with like: the C reference and helmstar are the same filter. Nothing is timed here."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not on the PATH: the C reference was not compiled")
def test_c_and_helmstar_agree(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from compiled_c import CReference
    from mekf import helmstar_program
    from problem import angle, simulate

    p = simulate(4, 60)
    q_c, nis_c = CReference().run(p)
    program, _, _ = helmstar_program(4, 60)
    q, nis = (np.asarray(a) for a in program(p.u, p.z))
    assert np.max(angle(q, q_c)) < 1e-11
    assert np.allclose(nis, nis_c, rtol=1e-6, atol=1e-8)
    # The filter works: after 60 steps of 20 arcsec stars the error is far below the 1e-3 rad it started from.
    assert np.max(angle(q[:, -1], p.q_BN[:, -1])) < 3e-4
    assert 4.0 < nis_c.mean() < 8.0
    for name in ("problem", "compiled_c", "mekf"):
        sys.modules.pop(name, None)
