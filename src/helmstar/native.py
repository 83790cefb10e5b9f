"""Compiled kernels, where installation found a C compiler: what a few inner loops of NumPy do, in one call.

The C sources lie beside the Python that they serve, and every kernel has its twin in NumPy, which is used without them and which
tests hold them against. HELMSTAR_NATIVE=0 in the environment switches them off.
"""

from __future__ import annotations

import ctypes
import os
import zlib
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np

ROOT = Path(__file__).parent


@cache
def kernels() -> Any | None:
    """The library (a ctypes.CDLL); None where there is none, or one of other sources than these."""
    if os.environ.get("HELMSTAR_NATIVE") == "0":
        return None
    try:
        library = ctypes.CDLL(str(ROOT / "_kernels.so"))
        library.helmstar_sources.restype = ctypes.c_uint32
        made_of = library.helmstar_sources()
    except (OSError, AttributeError):
        return None
    value = 0
    for path in sorted(ROOT.rglob("*.[ch]")):
        value = zlib.crc32(path.read_bytes().replace(b"\r\n", b"\n"), value)
    return library if made_of == value else None


def address(array: np.ndarray) -> int:
    """Of a contiguous array's first number, in a third of the time that `array.ctypes` takes: there are dozens a frame."""
    if array.size and array.flags.writeable:
        return ctypes.addressof(ctypes.c_char.from_buffer(cast(Any, array)))
    return array.ctypes.data


__all__ = ["address", "kernels"]
