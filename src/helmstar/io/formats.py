"""Which format a file has, and its rows: GRACE-FO Level-1, CCSDS AEM, STK .a, SPICE CK, or else a table.

A format is known by the file's first bytes, and by its name where these do not say enough. The maps of `[columns]` are for
tables only.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import DataError
from .aem import is_aem, read_aem
from .attitude_file import read_bytes
from .cleaning import Part, clean
from .columns import ColumnsConfiguration
from .gracefo import is_gracefo, read_gracefo
from .problems import ProblemLog
from .settings import FormatSettings
from .spice_ck import is_ck, read_ck
from .stk import is_stk, read_stk
from .table import read_table

_HEAD = 65536


def read_part(
    path: Path,
    maps: Sequence[ColumnsConfiguration],
    log: ProblemLog,
    settings: FormatSettings | None = None,
    max_problems: int = 1000,
) -> Part:
    """The rows of one file of any format that is read. Raises DataError."""
    settings = settings or FormatSettings()
    try:
        head = read_bytes(path, _HEAD)
    except (OSError, ValueError, DataError):
        head = b""  # the reader of tables says what is wrong with it
    try:
        if is_ck(path, head):
            return read_ck(path, settings, log)
        if is_aem(head):
            return read_aem(path, log)
        if is_stk(head):
            return read_stk(path, log)
        if head and is_gracefo(path, head):
            return read_gracefo(path, settings.gracefo, log)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    except UnicodeEncodeError as error:
        raise DataError(f"{path}: the name is not UTF-8, and SPICE's library opens no such file; rename it") from error
    return clean(read_table(path, max_problems), maps, log)
