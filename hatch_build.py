"""Builds the compiled kernels where a C compiler is at hand; without one helmstar computes the same with NumPy.

All src/helmstar/**/*.c become one shared library, helmstar/_kernels.so, which helmstar.native opens.
HELMSTAR_NATIVE=0 leaves it out.
"""

import os
import shutil
import subprocess
import sys
import sysconfig
import zlib
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface  # pyright: ignore[reportMissingImports]

# No -ffast-math and no contraction: what a number is, or whether it is one, must not depend on the compiler's mood.
FLAGS = ("-O3", "-std=c11", "-fPIC", "-shared", "-fno-math-errno", "-ffp-contract=off")


def checksum(sources: list[Path]) -> int:
    """Of the sources: as helmstar.native takes it."""
    value = 0
    for path in sources:
        value = zlib.crc32(path.read_bytes().replace(b"\r\n", b"\n"), value)
    return value


def compile_kernels(package: Path) -> Path | None:
    """The shared library, or None with a line of why."""
    out = package / "_kernels.so"
    sources = sorted(package.rglob("*.c"))
    compiler = os.environ.get("CC") or next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None)
    if os.environ.get("HELMSTAR_NATIVE") == "0" or not sources or sys.platform == "win32":
        return None
    if compiler is None:
        print(
            "helmstar: no C compiler, so the compiled kernels are left out; NumPy does the same, slower",
            file=sys.stderr,
        )
        return None
    part = out.with_suffix(f".{os.getpid()}.part")
    command = [*compiler.split(), *FLAGS, f"-DHELMSTAR_SOURCES={checksum(sorted(package.rglob('*.[ch]')))}u"]
    try:
        out.unlink(missing_ok=True)
        done = subprocess.run(
            [*command, "-o", str(part), *map(str, sources), "-lm"], capture_output=True, text=True, timeout=300
        )
        if done.returncode == 0:
            os.replace(part, out)
            return out
        why = done.stderr.strip()[-400:]
    except (OSError, subprocess.SubprocessError) as e:
        why = str(e)
    part.unlink(missing_ok=True)
    print(f"helmstar: the compiled kernels are left out ({why}); NumPy does the same, slower", file=sys.stderr)
    return None


class KernelsHook(BuildHookInterface):
    """Puts the library into the wheel, and beside the sources of an editable installation."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if compile_kernels(Path(self.root) / "src" / "helmstar") is not None:
            build_data["pure_python"] = False
            build_data["artifacts"].append("src/helmstar/_kernels.so")
            if sys.platform == "darwin":  # which of its names pip takes is the builder's business
                build_data["infer_tag"] = True
            else:  # plain C through ctypes: tied to the machine, not to one Python
                build_data["tag"] = "py3-none-" + sysconfig.get_platform().replace("-", "_").replace(".", "_")
