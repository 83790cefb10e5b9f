"""The one module that imports JAX first: float64 on, and a persistent compilation cache.

Every other module takes `jax` and `jnp` from here, so that no array exists before float64 is switched on.

- `HELMSTAR_CACHE_DIR` moves the compilation cache; set to an empty string it switches the cache off.
- A cache folder set for JAX itself (`JAX_COMPILATION_CACHE_DIR`) is respected.
"""

from __future__ import annotations

import os
from typing import Any

# One thread for each computation: small batched matrices lose more to splitting than they gain (measured: twice the CPU
# time). Parallelism is over blocks of runs instead, in other processes. XLA reads NPROC when its client starts.
os.environ.setdefault("NPROC", "1")

import jax
import jax.numpy as jnp

jax.config.update("jax_enable_x64", True)


def _enable_compilation_cache() -> None:
    """Keep every compiled program, however fast it compiled: a filter is many small programs."""
    folder = os.environ.get("HELMSTAR_CACHE_DIR")
    if folder is None:
        if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
            return
        from platformdirs import user_cache_dir

        folder = os.path.join(user_cache_dir("helmstar"), "jax")
    if not folder:
        return
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError:  # a read-only home must not stop a run; it only compiles again next time
        return
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


_enable_compilation_cache()

COMPILER_OPTIONS: dict[str, bool | int | str] = {
    "xla_backend_optimization_level": 1,
    "xla_cpu_use_fusion_emitters": False,
}
"""For `compile_program` and `jax.jit`: a third to a half of the compile time of XLA's defaults at about the same speed
(docs/performance.md)."""


def compile_program(lowered: Any) -> Any:
    """The executable of a lowered program, by COMPILER_OPTIONS where this version of XLA knows them."""
    try:
        return lowered.compile(COMPILER_OPTIONS)
    except Exception as error:  # XLA names no narrower type
        if "option" not in str(error).lower():
            raise
        return lowered.compile()


__all__ = ["COMPILER_OPTIONS", "compile_program", "jax", "jnp"]
