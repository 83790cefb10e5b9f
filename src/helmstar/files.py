"""Files that are written whole or not at all, and text that may hold any file's name."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A new file beside `path` to write to: it takes the place of `path` at the end, or is deleted when the block raises.

    So a reader sees the old file or the whole new one, and two writers never mix.
    """
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    os.close(handle)
    part = Path(name)
    try:
        yield part
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(part, 0o666 & ~mask)  # mkstemp makes files that only their owner may read
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def write_atomically(path: Path, text: str) -> Path:
    """Write text as UTF-8, lines ending in one newline, whole or not at all; what has no code is shown by `readable`."""
    with replacing(path) as part:
        part.write_text(readable(text), encoding="utf-8", newline="\n")
    return path


def readable(text: str) -> str:
    """Text with U+FFFD for each byte of a file's name that is not UTF-8 (Python keeps these as lone surrogates)."""
    return re.sub("[\ud800-\udfff]", "\ufffd", text)
