"""mekf.c, compiled by gcc for this machine into benchmarks/build/ and called through ctypes."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
from problem import DT, P0, SIGMA, SIGMA_U, SIGMA_V, Problem

SOURCE = Path(__file__).with_name("mekf.c")
FLAGS = ("-O3", "-march=native")
_Doubles = ctypes.POINTER(ctypes.c_double)


class NoCompiler(RuntimeError):
    """There is no gcc."""


def _pointer(a: np.ndarray):
    return a.ctypes.data_as(_Doubles)


def library() -> ctypes.CDLL:
    """The compiled library; raises NoCompiler with a plain reason when gcc is missing."""
    gcc = shutil.which("gcc")
    if gcc is None:
        raise NoCompiler("gcc is not on the PATH: the C reference cannot be compiled (on Debian: apt-get install gcc)")
    command = [gcc, *FLAGS, "-shared", "-fPIC", "-o"]
    version = subprocess.run([gcc, "--version"], capture_output=True, text=True, check=True).stdout
    name = hashlib.sha256(SOURCE.read_bytes() + " ".join([*command, version]).encode()).hexdigest()[:16]
    out = SOURCE.parent / "build" / f"mekf-{name}.so"
    if not out.exists():
        out.parent.mkdir(exist_ok=True)
        part = out.with_suffix(f".{os.getpid()}.part")
        subprocess.run([*command, str(part), str(SOURCE), "-lm"], check=True)
        os.replace(part, out)
    return ctypes.CDLL(str(out))


class CReference:
    """The scalar C filter."""

    def __init__(self) -> None:
        lib = library()
        self._run, self._loop = lib.run, lib.stream_loop
        self._run.restype = None
        self._run.argtypes = [ctypes.c_int, ctypes.c_int, *[ctypes.c_double] * 5, *[_Doubles] * 4]
        self._loop.restype = None
        self._loop.argtypes = [ctypes.c_int, *[ctypes.c_double] * 4, *[_Doubles] * 6]

    def run(self, p: Problem) -> tuple[np.ndarray, np.ndarray]:
        """Attitudes (runs, steps, 4) and NIS (runs, steps) after each step."""
        u, z = np.ascontiguousarray(p.u), np.ascontiguousarray(p.z)
        q, nis = np.empty((p.runs, p.steps, 4)), np.empty((p.runs, p.steps))
        self._run(p.runs, p.steps, DT, SIGMA_V, SIGMA_U, SIGMA, P0, *map(_pointer, (u, z, q, nis)))
        return q, nis

    def step_seconds(self, p: Problem) -> np.ndarray:
        """Wall seconds of each step of run 0, one ctypes call each; some 1 us of it is the call itself."""
        q, b, P, nis = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), P0 * np.eye(6), np.zeros(1)
        u, z = np.ascontiguousarray(p.u[0]), np.ascontiguousarray(p.z[0])
        state = tuple(map(_pointer, (q, b, P)))
        inputs = [(_pointer(u[k]), _pointer(z[k])) for k in range(p.steps)]
        out, loop, n = _pointer(nis), self._loop, ctypes.c_int(1)
        constants = tuple(map(ctypes.c_double, (DT, SIGMA_V, SIGMA_U, SIGMA)))
        seconds = np.empty(p.steps)
        clock = time.perf_counter
        for k, (uk, zk) in enumerate(inputs):
            start = clock()
            loop(n, *constants, *state, uk, zk, out)
            seconds[k] = clock() - start
        return seconds
