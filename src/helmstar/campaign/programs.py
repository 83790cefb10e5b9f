"""Programs on flat arrays, traced once and kept: a warm start neither traces nor lowers helmstar's functions again.

Tracing and lowering a filter costs as much as loading its executable. So a call is exported to StableHLO (JAX's portable
format, no pickle) and kept beside the compilation cache, under a name that is a hash of all that it depends on: the sources of
helmstar, JAX's version, the call's function, statics and shapes. What cannot be read is traced again.
"""

from __future__ import annotations

import hashlib
import os
import re
from functools import cache
from pathlib import Path
from typing import Any

from ..backend import compile_program, jax, jnp
from ..scenarios.experiment import Call


def signature(tree: Any) -> tuple:
    """Structure, shapes and types of a tree: equal for calls that can share a program."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, tuple((jnp.shape(a), str(jnp.result_type(a))) for a in leaves)


def exported(call: Call, data: Any) -> Any:
    """The call as `jax.export.Exported`, on the leaves of (arguments, data) and giving the leaves of its result.

    `data` is a tree of arrays or shapes.
    """
    path = _stored(call, data)
    if path is not None and path.exists():
        try:
            return jax.export.deserialize(bytearray(path.read_bytes()))
        except Exception:  # a damaged or foreign file, whatever the reader says of it: made anew below
            path.unlink(missing_ok=True)
    leaves, structure = jax.tree.flatten((call.arguments, data))

    def flat(*leaves: Any) -> tuple:
        arguments, data = jax.tree.unflatten(structure, leaves)
        return tuple(jax.tree.leaves(call.function(*arguments, data, **call.static)))

    made = jax.export.export(jax.jit(flat))(*map(_shape, leaves))
    if path is not None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            part = path.with_suffix(f".{os.getpid()}.part")
            part.write_bytes(made.serialize())
            os.replace(part, path)
        except OSError:
            pass  # a full or read-only disk only means that the next start traces again
    return made


def compiled(program: Any) -> Any:
    """Executable of an exported call, taking and giving its leaves."""
    return compile_program(jax.jit(program.call).lower(*program.in_avals))


def _shape(a: Any) -> Any:
    return jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a))


def _stored(call: Call, data: Any) -> Path | None:
    """Where the exported call is kept; None without a compilation cache."""
    folder = jax.config.values.get("jax_compilation_cache_dir")
    if not folder:
        return None
    statics = sorted(call.static.items())
    name = f"{call.function.__module__}.{call.function.__qualname__}"
    text = repr((_sources(), jax.__version__, jax.default_backend(), name, statics, signature((call.arguments, data))))
    text = re.sub(r" at 0x[0-9a-f]+", "", text)  # functions by name: their addresses change
    return Path(folder) / "helmstar" / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.stablehlo"


@cache
def _sources() -> str:
    """Hash of all of helmstar's sources."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()
