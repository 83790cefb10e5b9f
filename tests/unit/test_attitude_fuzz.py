"""Whatever tables and configuration `helmstar attitude` is given, it ends with a result or an error, never a traceback."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from helmstar.cli import main

ROWS = 120
HEADER = "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,q_bn_x,q_bn_y,q_bn_z,q_bn_w"
STAR_HEADER = "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,star_b_x,star_b_y,star_b_z,star_n_x,star_n_y,star_n_z"
relaxed = settings(
    max_examples=40, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
CELL = st.sampled_from(
    ["", "0", "-1", "1", "0.5", "nan", "inf", "-inf", "1e308", "-1e308", "1e-308", "1e18", "1e5", "57.3", "x", '"', "é"]
)
KEYS = st.sampled_from(
    [
        "", "[gyro]\narw_arcsec_sqrt_s = 0.0", "[gyro]\narw_arcsec_sqrt_s = 1e300", "[gyro]\narw_deg_sqrt_h = 1e-300",
        "[gyro]\nrrw_rad_s_sqrt_s = 1e9", "[gyro]\nreading = 'increment_rad'", "[gyro]\nreading = 'mean_since_previous'",
        "[gyro]\ntime_offset_s = 1e9", "[gyro]\ninitial_drift_sigma_arcsec_s = 1e-12", "[star]\nsigma_arcsec = 1e-9",
        "[star]\nsigma_arcsec = 1e9", "[star]\ntime_offset_s = -20.5", "[filter]\ngate_probability = 0",
        "[filter]\ngate_probability = 0.9\nreopen_after = 1", "[star]\nsigma_arcsec = 'x'", "[star\n", "[nothing]\na = 1",
    ]
)  # fmt: skip

EXTREMES = [  # the ends of what is allowed
    "[gyro]\narw_rad_sqrt_s = 10\nrrw_rad_s_sqrt_s = 10\n[star]\nsigma_arcsec = 648000",
    "[gyro]\narw_rad_sqrt_s = 1e-15\nrrw_rad_s_sqrt_s = 1e-15\n[star]\nsigma_arcsec = 1e-6",
    "[gyro]\narw_rad_sqrt_s = 0\nrrw_rad_s_sqrt_s = 0\n[star]\nsigma_arcsec = 1e-6",
    "[star]\nsigma_cross_arcsec = 0.648\nsigma_roll_arcsec = 648000\nq_sb = [0.5, 0.5, 0.5, 0.5]",
    "[gyro]\ninitial_drift_sigma_arcsec_s = 2e8", "[gyro]\ninitial_drift_sigma_arcsec_s = 1e-9",
    "[filter]\nreopen_after = 1000000", "[filter]\nreopen_after = 99999999999999999999",
    "[gyro]\nreading = 'increment_rad'",
]  # fmt: skip


def table(star: bool) -> list[list[str]]:
    """Cells of a good table: a slow turn, an attitude or one star in each row."""
    rng = np.random.default_rng(5)
    rate = np.array([1e-3, -2e-3, 5e-4])
    rows = []
    for k in range(ROWS):
        R = Rotation.from_rotvec(rng.normal(size=3) * 1e-5) * Rotation.from_rotvec(-rate * k)
        n = rng.normal(size=3)
        seen = [*(R.apply(n) / np.linalg.norm(n)), *(n / np.linalg.norm(n))] if star else R.as_quat()
        # Two stars share an instant, so that there is an attitude to start from.
        rows.append([f"{v:.9g}" for v in (k // 2 * 2 if star else k, *(rate + rng.normal(size=3) * 1e-6), *seen)])
    return rows


def run(folder: Path, files: dict[str, bytes], *more: str) -> tuple[int, str, str]:
    for name, content in files.items():
        (folder / name).write_bytes(content)
    tables = [str(folder / name) for name in files if not name.endswith(".toml")]
    config = ["--config", str(folder / "sensors.toml")] if "sensors.toml" in files else []
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(["attitude", *tables, *config, "--out", str(folder / "out"), "--json", *more])
    return code, out.getvalue(), err.getvalue()


def no_constant(name: str) -> float:
    raise AssertionError(f"{name} in JSON")


def ends_well(code: int, out: str, err: str) -> dict | None:
    """A result of finite numbers, or one error as the last line; `main` raising is a traceback."""
    assert "Traceback" not in err
    if code == 0:
        return json.loads(out, parse_constant=no_constant)
    assert (code, out) == (1, "")
    assert err.splitlines()[-1].startswith("error: ")
    return None


def join(header: str, rows: list[list[str]]) -> bytes:
    return "\n".join([header, *(",".join(row) for row in rows)]).encode()


def test_the_undamaged_tables_give_attitudes(tmp_path):
    for header, star in ((HEADER, False), (STAR_HEADER, True)):
        result = ends_well(*run(tmp_path, {"t.csv": join(header, table(star))}))
        assert result is not None
        assert result["updates"] > 40


@relaxed
@given(
    star=st.booleans(),
    cells=st.lists(st.tuples(st.integers(0, ROWS - 1), st.integers(0, 9), CELL), max_size=8),
    columns=st.lists(st.tuples(st.integers(0, 9), CELL), max_size=1),
    rows=st.lists(st.tuples(st.integers(0, ROWS - 1), st.sampled_from(["drop", "repeat", "swap", "cut"])), max_size=6),
    length=st.sampled_from([ROWS, ROWS, ROWS, 0, 1, 2, 3, 5]),
    keys=st.lists(KEYS, max_size=2),
    strict=st.booleans(),
)
@example(star=False, cells=[], columns=[(1, "1e308")], rows=[], length=ROWS, keys=[], strict=False)
@example(star=False, cells=[], columns=[(7, "0")], rows=[], length=ROWS, keys=[], strict=False)
def test_damaged_tables_and_odd_configurations(tmp_path, star, cells, columns, rows, length, keys, strict):
    header, good = (STAR_HEADER if star else HEADER), table(star)[:length]
    for column, value in columns:
        for row in good:
            row[column % len(row)] = value
    for row, column, value in cells:
        if row < len(good):
            good[row][column % len(good[row])] = value
    for row, what in rows:
        if row >= len(good):
            continue
        if what == "drop":
            del good[row]
        elif what == "repeat":
            good.insert(row, good[row])
        elif what == "swap":
            good[row], good[-1] = good[-1], good[row]
        else:
            good[row] = good[row][:3]
    files = {"t.csv": join(header, good), "sensors.toml": "\n".join(keys).encode()}
    ends_well(*run(tmp_path, files, *(["--strict"] if strict else [])))


@settings(relaxed, max_examples=30)
@given(
    jump_s=st.sampled_from([0.0, 1e4, 1e8, 1e14]),
    step_s=st.sampled_from([1.0, 1e-7, 2.0 * np.pi * 20, 1e6, 1e13]),
    rate=st.sampled_from([0.0, 1e-3, 0.05, 10.0, 900.0, 1e11]),
    pattern=st.sampled_from(["constant", "alternating", "random"]),
    attitude=st.sampled_from(["still", "random"]),
    keys=st.sampled_from(["", *EXTREMES]),
)
@example(jump_s=1e8, step_s=1.0, rate=1e-5, pattern="random", attitude="still", keys="")
@example(jump_s=1e14, step_s=1.0, rate=0.05, pattern="random", attitude="still", keys="")
@example(jump_s=0.0, step_s=1.0, rate=900.0, pattern="alternating", attitude="still", keys="")
@example(jump_s=0.0, step_s=1.0, rate=900.0, pattern="random", attitude="still", keys="")
@example(jump_s=0.0, step_s=2.0 * np.pi * 20, rate=0.05, pattern="constant", attitude="still", keys="")
@example(jump_s=0.0, step_s=1.0, rate=1e11, pattern="constant", attitude="still", keys="")
@example(jump_s=0.0, step_s=1e13, rate=1e-5, pattern="random", attitude="random", keys=EXTREMES[0])
def test_clocks_rates_and_attitudes_that_no_body_has(tmp_path, jump_s, step_s, rate, pattern, attitude, keys):
    rng = np.random.default_rng(3)
    time = step_s * np.arange(ROWS) + np.where(np.arange(ROWS) > ROWS // 2, jump_s, 0.0)
    one = {"constant": 1.0, "alternating": (-1.0) ** np.arange(ROWS), "random": rng.normal(size=ROWS)}[pattern]
    rates = np.column_stack([rate * one * np.ones(ROWS), 1e-6 * rng.normal(size=(ROWS, 2))])
    spread = np.pi if attitude == "random" else 1e-5
    q = Rotation.from_rotvec(spread * rng.normal(size=(ROWS, 3))).as_quat()
    rows = [[f"{v:.17g}" for v in row] for row in np.column_stack([time, rates, q])]
    ends_well(*run(tmp_path, {"t.csv": join(HEADER, rows), "sensors.toml": keys.encode()}))


@settings(relaxed, max_examples=25)
@given(
    content=st.binary(max_size=200),
    name=st.sampled_from(["t.csv", "t.parquet", "t.txt"]),
    config=st.binary(max_size=60),
)
def test_arbitrary_bytes_as_table_and_configuration(tmp_path, content, name, config):
    ends_well(*run(tmp_path, {name: content, "sensors.toml": config}))
