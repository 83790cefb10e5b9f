"""Programs on flat arrays, traced once and kept: a warm start neither traces nor lowers helmstar's functions again.

Tracing and lowering a filter costs as much as loading its executable. So a call is exported to StableHLO (JAX's portable
format, no pickle) and kept beside the compilation cache, under a name that is a hash of all that it depends on: the sources of
helmstar, JAX's version, the call's function and every static value that its statics, arguments and data hold, functions by
their place in the sources, with what they close over. Only helmstar's own sources are hashed: a call with a function or class
from elsewhere (a user's, a test's) is traced anew each time. What cannot be read is traced again.
"""

from __future__ import annotations

import hashlib
import inspect
from dataclasses import fields, is_dataclass
from functools import cache, partial
from pathlib import Path
from types import FunctionType
from typing import Any

from ..backend import compile_program, jax, jnp
from ..files import replacing
from ..scenarios.experiment import Call


def signature(tree: Any) -> tuple:
    """Structure, shapes and types of a tree: equal for calls that can share a program."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, tuple((jnp.shape(a), str(jnp.result_type(a))) for a in leaves)


def exported(call: Call, data: Any, origin: tuple[Call, Any] | None = None) -> Any:
    """The call as `jax.export.Exported`, on the leaves of (arguments, data) and giving the leaves of its result.

    `data` is a tree of arrays or shapes; with an origin, a call and its data that it is the result of, a function that gives
    the tree: what is kept is then found without asking it, which spares tracing the origin.
    """
    path = _stored(call, data) if origin is None else _stored(call, origin[1], origin[0])
    if path is not None and path.exists():
        try:
            return jax.export.deserialize(bytearray(path.read_bytes()))
        except Exception:  # a damaged or foreign file, whatever the reader says of it: made anew below
            path.unlink(missing_ok=True)
    leaves, structure = jax.tree.flatten((call.arguments, data if origin is None else data()))

    def flat(*leaves: Any) -> tuple:
        arguments, data = jax.tree.unflatten(structure, leaves)
        return tuple(jax.tree.leaves(call.function(*arguments, data, **call.static)))

    made = jax.export.export(jax.jit(flat))(*map(_shape, leaves))
    if path is not None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path) as part:
                part.write_bytes(made.serialize())
        except OSError:
            pass  # a full or read-only disk only means that the next start traces again
    return made


def compiled(program: Any) -> Any:
    """Executable of an exported call, taking and giving its leaves."""
    return compile_program(jax.jit(program.call).lower(*program.in_avals))


def has_cache() -> bool:
    """Whether compiled programs are kept where another process finds them."""
    return bool(jax.config.values.get("jax_compilation_cache_dir"))


def _shape(a: Any) -> Any:
    return jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a))


def _stored(call: Call, data: Any, origin: Call | None = None) -> Path | None:
    """Where the exported call is kept; None without a compilation cache, or for a call that is not helmstar's alone. With an
    origin the call is on what that call makes of `data`."""
    folder = jax.config.values.get("jax_compilation_cache_dir")
    if not folder:
        return None
    tree = (call.arguments, data) if origin is None else (call.arguments, (origin.arguments, data))
    try:
        what = [_described(v) for c in (call, origin) if c for v in (c.function, dict(c.static))]
        structure = _structure(jax.tree.structure(tree))
    except _NotOurs:
        return None
    text = repr((_sources(), jax.__version__, jax.default_backend(), what, structure, signature(tree)[1]))
    return Path(folder) / "helmstar" / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.stablehlo"


class _NotOurs(Exception):
    """A static value whose meaning is not in helmstar's sources."""


def _structure(tree: Any) -> Any:
    """Of a tree: its node types with their static data."""
    node = tree.node_data()
    return node if node is None else (_described(node), [_structure(child) for child in tree.children()])


def _described(value: Any, within: tuple[int, ...] = ()) -> Any:
    """A static value in words that are equal for equal meanings in any process. Raises _NotOurs where that is not known.

    within: identities of the functions around it, which may close over themselves.
    """
    if value is None or isinstance(value, bool | int | float | complex | str | bytes):
        return repr(value)
    if id(value) in within:
        return f"around {len(within) - within.index(id(value))}"
    within = (*within, id(value))
    if isinstance(value, type):
        if value.__module__ != "builtins" and not _ours(value.__module__):
            raise _NotOurs
        return value.__module__, value.__qualname__
    if isinstance(value, partial):
        return "partial", [_described(v, within) for v in (value.func, value.args, value.keywords)]
    if isinstance(value, dict):
        return "dict", [(_described(k, within), _described(v, within)) for k, v in value.items()]
    if isinstance(value, tuple | list):
        return _described(type(value)), [_described(v, within) for v in value]
    if is_dataclass(value):
        return _described(type(value)), [(f.name, _described(getattr(value, f.name), within)) for f in fields(value)]
    if type(value) is _JITTED:
        return "jit", _described(inspect.unwrap(value), within)
    if not isinstance(value, FunctionType) or not _ours(value.__globals__["__name__"]):
        raise _NotOurs
    code, cells = value.__code__, [c.cell_contents for c in value.__closure__ or ()]
    place = (value.__module__, value.__qualname__, code.co_firstlineno, code.co_code)
    return place, [_described(v, within) for v in (cells, value.__defaults__, value.__kwdefaults__)]


def _ours(module: str) -> bool:
    return module == "helmstar" or module.startswith("helmstar.")


_JITTED = type(jax.jit(lambda: None))


@cache
def _sources() -> str:
    """Hash of all of helmstar's sources."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()
