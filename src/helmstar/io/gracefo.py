"""GRACE Follow-On Level-1 ASCII products SCA1A, SCA1B, IMU1A and IMU1B (Level-1 Data Product User Handbook, JPL D-56935).

A header in YAML ends at "# End of YAML header"; its `variables` name the columns in order, which is what is believed. Each
row below it is one record, cells apart by blanks. Times are GPS seconds since 2000-01-01 12:00:00, whole in `gps_time` or in
two columns `rcvtime_intg` (s) and `rcvtime_frac` (microseconds); those of the 1A products are the instrument's own, some
ms to 1 s off GPS time, which TIM1B and CLK1B would correct (`time_offset_s` stands in for them).

Quaternions are [quatangle, quaticoeff, quatjcoeff, quatkcoeff], scalar first, from the inertial frame to the science
reference frame (SRF), our B: the rotation of the axes, so v_N = R(q) v_B and q_BN is the conjugate. Flight rows say so:
between successive rows of SCA1B this sense gives a rate of 1.1077e-3 rad/s (one turn in 94.5 min) about y of the SRF and
3e-7 about x and z, the pitch rate of an orbit; the other gives a vector along no axis.
SCA1A has one attitude per star camera in that camera's frame; QSA1B's mounting turns it into the SRF:
q_SRF = q_camera (x) q_QSA1B as Hamilton products of the numbers in the files.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import csv as arrow_csv

from ..errors import DataError
from .attitude_file import AttitudeSamples, attitude_part, conjugate, read_bytes
from .cleaning import Part
from .clock import DAY_S, TAI_MINUS_GPS_S, Instants
from .problems import ProblemLog
from .settings import GraceFoConfiguration
from .table import Table

END_OF_HEADER = b"# End of YAML header"
_NAME = re.compile(r"^(SCA1A|SCA1B|IMU1A|IMU1B)_.*\.(txt|dat|asc)(\.gz)?$", re.IGNORECASE)
_TIME = ["rcvtime_intg", "rcvtime_frac"]
_QUATERNION = ["quatangle", "quaticoeff", "quatjcoeff", "quatkcoeff"]
_IMU = [*_TIME, "time_ref", "GRACEFO_id", "gyro_id", "FiltAng", "qualflg"]
DOCUMENTED: dict[str, list[list[str]]] = {  # where the header does not say; several are told apart by their width
    "SCA1A": [[*_TIME, "GRACEFO_id", "sca_id", "sca_desig", *_QUATERNION, "nlocks", "nstars", "sca_confid", "sca_null1",
               "sca_null2", "sca_mode", "qualflg"]],
    "SCA1B": [["gps_time", "GRACEFO_id", "sca_id", *_QUATERNION, "qual_rss", "qualflg"]],
    "IMU1A": [_IMU],
    "IMU1B": [_IMU, ["gps_time", "GRACEFO_id", "gyro_id", "FiltAng", "qualflg"]],
}  # fmt: skip
_BIT = re.compile(r"\bbit\s*(\d{1,2})\s*[=:]\s*(.*?)(?=[,;]?\s*\bbit\s*\d{1,2}\s*[=:]|$)", re.IGNORECASE)
_NOT_BELIEVED = re.compile(
    r"invalid|not valid|bad|missing|gap|fill|interpolat|extrapolat|outlier|no data|suspect", re.I
)


def is_gracefo(path: Path, head: bytes) -> bool:
    """Whether a file that is called and begins so is one of these products."""
    if _NAME.match(path.name):
        return True
    return head.lstrip().startswith(b"header:") and (b"GRACE" in head or END_OF_HEADER in head)


@dataclass(frozen=True)
class Product:
    """One file: its rows as text columns by name, and what the header says: `units` by column, `flags` bit to meaning."""

    table: Table
    satellite: str
    units: dict[str, str] = field(default_factory=dict)
    flags: dict[int, str] = field(default_factory=dict)


def read_gracefo(path: Path, settings: GraceFoConfiguration, log: ProblemLog) -> Part:
    """Gyro or attitude rows of one file, in SI units and SRF axes. Raises DataError, OSError."""
    product = read_product(path, log)
    columns = product.table.columns
    if "FiltAng" in columns:
        from .gracefo_imu import imu_part

        return imu_part(product, settings, log)
    if missing := [name for name in _QUATERNION if name not in columns]:
        raise DataError(
            f"{path}: a GRACE-FO file with columns {', '.join(columns)[:200]}, without {', '.join(missing)}; of these "
            "products SCA1A, SCA1B, IMU1A and IMU1B are read, which have quatangle, quaticoeff .. or FiltAng"
        )
    return _sca_part(product, settings, log)


def read_product(path: Path, log: ProblemLog) -> Product:
    """Header and rows. Bad lines are noted in `log`; what is not such a file raises DataError."""
    file, content = str(path), read_bytes(path)
    head, end, body = content.partition(END_OF_HEADER)
    if not end:
        raise DataError(
            f"{file}: there is no line '{END_OF_HEADER.decode()}'; a GRACE-FO Level-1 ASCII file with its header is needed"
        )
    header = head.decode("utf-8", "replace").splitlines()
    names, units, flags = _variables(header)
    named = re.search(r"(SCA1A|SCA1B|IMU1A|IMU1B)", path.name.upper())
    body = body.partition(b"\n")[2]
    first = head.count(b"\n") + 2
    body = _tidy(body)
    widths = {len(line.split()) for line in body[:8192].split(b"\n")[:-1] or [body]}  # the last line may be cut
    layouts = DOCUMENTED[named[1]] if named else []
    fitting = [layout for layout in layouts if len(layout) in widths]
    if len(names) not in widths and fitting:
        names = fitting[0]
    elif not names and layouts:
        names = layouts[0]
    if not names:
        raise DataError(
            f"{file}: the header has no list of variables, and the name does not say the product; call the file as it "
            f"was delivered, such as SCA1B_2022-01-01_C_04.txt"
        )
    columns, row = _rows(file, body, names, first, log)
    texts = columns.get("GRACEFO_id")
    satellite = str(texts[0].as_py()) if texts is not None and len(texts) else ""
    return Product(Table(file, columns, row), satellite, units, flags)


def _variables(header: list[str]) -> tuple[list[str], dict[str, str], dict[int, str]]:
    """Column names in order, their units, and the meaning of qualflg's bits, from a header's lines."""
    names: list[str] = []
    units: dict[str, str] = {}
    flags: dict[int, str] = {}
    inside = False
    for line in header:
        text = line.strip()
        if re.match(r"^variables\s*:", text):
            inside = True
            continue
        if not inside:
            continue
        if found := re.match(r"^-\s+(\w+)\s*:\s*$", text):
            names.append(found[1])
        elif names and (found := re.match(r"^units?\s*:\s*(.+)$", text)):
            units[names[-1]] = found[1].strip().strip("'\"")
        elif names and names[-1] == "qualflg":
            for found in _BIT.finditer(text):
                flags[int(found[1])] = found[2].strip(" ,;'\"")
    return names, units, flags


def _tidy(body: bytes) -> bytes:
    """Lines with single blanks and none at either end, as a fast reader needs them; line numbers stay."""
    if b"\r" in body:
        body = body.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"\t" in body or b"  " in body or b"\n " in body or b" \n" in body or body[:1] == b" " or body[-1:] == b" ":
        body = re.sub(rb"[ \t]+", b" ", body)
        body = re.sub(rb"(?m)^ | $", b"", body)
    return body.replace(b"\x00", b"?")


def _rows(
    file: str, body: bytes, names: list[str], first: int, log: ProblemLog
) -> tuple[dict[str, pa.ChunkedArray], np.ndarray]:
    """Text columns and the line number of each row. `first`: the line number of the body's first line."""
    if len(set(names)) != len(names):
        raise DataError(f"{file}: the header names a column twice")
    dropped: list[int] = []

    def skip(row: arrow_csv.InvalidRow) -> str:
        dropped.append(row.number)
        return "skip"

    texts = dict.fromkeys(names, pa.string())
    body = body.rstrip(b"\n")
    if not body:
        raise DataError(f"{file}: there is no row below the header")
    try:
        content = arrow_csv.read_csv(
            io.BytesIO(body.decode("utf-8", "replace").encode()),
            read_options=arrow_csv.ReadOptions(column_names=names, use_threads=False, block_size=1 << 26),
            parse_options=arrow_csv.ParseOptions(
                delimiter=" ", quote_char=False, ignore_empty_lines=False, invalid_row_handler=skip
            ),
            convert_options=arrow_csv.ConvertOptions(column_types=texts, strings_can_be_null=False),
        )
    except (pa.ArrowException, ValueError) as error:
        raise DataError(f"{file}: the rows cannot be read: {str(error)[:200]}") from error
    number = np.arange(1, content.num_rows + len(dropped) + 1)
    row = np.setdiff1d(number, np.array(dropped, dtype=int), assume_unique=True) + first - 1
    lines = body.split(b"\n") if dropped else []
    ragged = [n + first - 1 for n in dropped if lines[n - 1].strip() and not lines[n - 1].startswith(b"#")]
    message = f"the row does not have the {len(names)} cells that the header names"
    log.add(file, np.array(ragged, dtype=int), "ragged", message, "dropped")
    if not content.num_rows:
        raise DataError(f"{file}: no row has the {len(names)} cells that the header names: {', '.join(names)[:200]}")
    return dict(zip(names, content.columns)), row


def times(product: Product, log: ProblemLog) -> tuple[Instants, np.ndarray]:
    """Times of the rows and which rows have one; the others are noted."""
    table = product.table
    whole = next((name for name in ("gps_time", "rcvtime_intg", "rcv_time") if name in table.columns), None)
    if whole is None:
        raise DataError(f"{table.file}: the header names no gps_time and no rcvtime_intg")
    second = table.numbers(whole).value
    good = np.isfinite(second) & (np.abs(second) < 1e11)
    fraction = np.zeros(len(table))
    if "rcvtime_frac" in table.columns:
        fraction = table.numbers("rcvtime_frac").value * 1e-6
        good &= np.isfinite(fraction) & (np.abs(fraction) <= 1.0)
    log.add(table.file, table.row[~good], "time_unreadable", f"{whole} or its fraction is no time", "dropped")
    second = np.where(good, second, 0.0) + 0.5 * DAY_S  # from noon to midnight
    day = np.floor(second / DAY_S)
    rest = second - day * DAY_S + np.where(good, fraction, 0.0) + TAI_MINUS_GPS_S
    return Instants(day.astype(np.int64), rest, absolute=True), good


def unflagged(product: Product, settings: GraceFoConfiguration, log: ProblemLog) -> np.ndarray:
    """Mask of the rows that qualflg does not speak against; those it marks are noted, dropped or not.

    Which bits drop a row: `reject_bits`; without it those whose meaning in the header is that the value was not measured
    (filled, interpolated, extrapolated, invalid, ..), or every bit whose meaning the header does not give.
    """
    table = product.table
    if "qualflg" not in table.columns:
        return np.ones(len(table), dtype=bool)
    encoded = table.texts("qualflg").combine_chunks().dictionary_encode()
    values, index = encoded.dictionary.to_pylist(), encoded.indices.to_numpy()
    reject, mark = np.zeros(len(values), dtype=bool), np.zeros(len(values), dtype=bool)
    meaning = []
    for i, text in enumerate(values):
        is_binary = bool(text) and set(text) <= {"0", "1"} and len(text) <= 64
        bits = [bit for bit, digit in enumerate(reversed(text)) if digit == "1"] if is_binary else []
        against = [bit for bit in bits if _speaks_against(bit, product, settings)]
        reject[i], mark[i] = bool(against) or not is_binary, bool(bits)
        said = "; ".join(
            f"bit {bit}: {product.flags.get(bit, 'not explained in the header')}" for bit in against or bits
        )
        choice = "; [gracefo] reject_bits chooses" if reject[i] and is_binary else ""
        meaning.append(f"qualflg {text[:64]!r} ({said or 'no row of bits'}){choice}")
    for chosen, action in ((reject, "dropped"), (mark & ~reject, "used")):
        which = np.flatnonzero(chosen[index])
        kinds = index[which]

        def message(i: int, kinds: np.ndarray = kinds) -> str:
            return meaning[kinds[i]]

        log.add(table.file, table.row[which], "flagged", message, action)
    return ~reject[index]


def _speaks_against(bit: int, product: Product, settings: GraceFoConfiguration) -> bool:
    if settings.reject_bits is not None:
        return bit in settings.reject_bits
    meaning = product.flags.get(bit)
    return meaning is None or bool(_NOT_BELIEVED.search(meaning))


def _sca_part(product: Product, settings: GraceFoConfiguration, log: ProblemLog) -> Part:
    """Attitudes of SCA1A or SCA1B."""
    table = product.table
    instants, timed = times(product, log)
    stays = timed & unflagged(product, settings, log)
    numbers = [table.numbers(name) for name in _QUATERNION]
    bad = np.logical_or.reduce([column.bad for column in numbers])
    log.add(table.file, table.row[stays & bad], "not_a_number", "the quaternion holds something else", "dropped")
    stays &= ~bad
    q = np.stack([numbers[i].value for i in (1, 2, 3, 0)], axis=1)
    if "sca_desig" in table.columns or "nlocks" in table.columns:  # SCA1A: one camera's frame
        stays, mounting = _one_camera(product, stays, settings, log)
        with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is noted below
            q = _hamilton(q, mounting)
    q_BN = conjugate(q) if settings.quaternion_sense == "nb" else q
    chosen = np.flatnonzero(stays)
    samples = AttitudeSamples(
        table.row[chosen], instants.select(chosen), np.ones(len(chosen), dtype=bool), q_BN[chosen]
    )
    return attitude_part(table.file, samples, "gps_time", "gps", log)


def _one_camera(
    product: Product, stays: np.ndarray, settings: GraceFoConfiguration, log: ProblemLog
) -> tuple[np.ndarray, np.ndarray]:
    """The rows of the star camera that is used, and its mounting (4,), scalar last."""
    table = product.table
    camera = table.numbers("sca_id").value if "sca_id" in table.columns else np.ones(len(table))
    present = sorted({int(c) for c in np.unique(camera[stays & np.isfinite(camera)]) if c == int(c)})
    listed = ", ".join(map(str, present[:10])) or "none"
    known = [c for c in present if str(c) in settings.mounting]
    if settings.sca_id is not None and settings.sca_id not in present:
        raise DataError(f"{table.file}: no usable row of sca_id {settings.sca_id}; there are {listed}")
    used = settings.sca_id if settings.sca_id is not None else next(iter(known), None)
    if used is None:
        raise DataError(
            f"{table.file}: SCA1A holds attitudes of star cameras (sca_id {listed}) in their own frames; say how they sit "
            "in the science reference frame by the four numbers of QSA1B, in sensors.toml: [gracefo] "
            "mounting.1 = [cos, i, j, k] (or sca_id = 1 alone, to have that camera's frame as B)"
        )
    w, x, y, z = settings.mounting.get(str(used), (1.0, 0.0, 0.0, 0.0))
    if used not in known:
        first = np.flatnonzero(stays & (camera == used))[:1]
        log.add(
            table.file, table.row[first], "frame", f"B is the frame of camera {used}, for it has no mounting", "used"
        )
    others = stays & (camera != used)
    log.add(table.file, table.row[others], "unused", f"another star camera than sca_id {used}", "not used")
    stays = stays & (camera == used)
    if "sca_confid" in table.columns:
        confidence = table.numbers("sca_confid").value
        poor = stays & ~(confidence < settings.confidence_below)
        message = f"sca_confid is not below {settings.confidence_below}"
        log.add(table.file, table.row[poor], "flagged", message, "dropped")
        stays &= ~poor
    return stays, np.array([x, y, z, w])


def _hamilton(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Hamilton's product of quaternions (n, 4) and (4,), scalar last."""
    v, w = p[:, :3], p[:, 3:]
    vector = w * q[:3] + q[3] * v + np.cross(v, np.broadcast_to(q[:3], v.shape))
    return np.hstack([vector, w * q[3] - v @ q[:3, None]])
