"""A campaign's folder: manifest, finished blocks, and the one Dataset they make. NetCDF and JSON; nothing is pickled.

campaign.json      what was asked for; a resume must ask for the same
blocks/000000.nc   one finished block, written whole or not at all
results.nc         the Dataset of all finished runs
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ..errors import CampaignError
from ..files import replacing, write_atomically
from ..scenarios.experiment import Experiment
from .engine import Block

KEPT_BYTES = 2**28
"""How much of what was just written stays in memory, so that it need not be read again."""


def fingerprint(manifest: dict[str, Any]) -> str:
    """Of everything that a run's bits depend on: the number of runs is not part of it."""
    relevant = {k: manifest[k] for k in ("specification", "estimators", "helmstar_version")}
    return hashlib.sha256(json.dumps(relevant, sort_keys=True).encode()).hexdigest()[:16]


class Store:
    """The folder of one campaign. Raises CampaignError where the folder cannot be used as asked.

    discarded: what of an earlier campaign was deleted, in words ("100 finished runs"); empty where nothing was.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any], resume: bool):
        self.folder = folder
        self.blocks = folder / "blocks"
        self.discarded = ""
        self._kept: dict[int, xr.Dataset] = {}  # of this process, KEPT_BYTES at most
        self._room = KEPT_BYTES
        self.manifest = manifest | {"fingerprint": fingerprint(manifest)}
        path = folder / "campaign.json"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if resume:
                self._check(path)
            else:
                self._discard(path)
            self.blocks.mkdir(exist_ok=True)
            write_atomically(path, json.dumps(self.manifest, indent=2))
        except OSError as error:
            raise CampaignError(f"--out {folder}: cannot write there: {error.strerror or error}") from error

    def _discard(self, path: Path) -> None:
        """Delete an earlier campaign's blocks: only files that a campaign wrote, so only beside its manifest."""
        if not path.exists():
            if any(self.blocks.glob("*.nc")):
                raise CampaignError(
                    f"--out {self.folder}: {self.blocks} holds .nc files, but {path.name} is missing, so they may not be "
                    "helmstar's and are not overwritten; give another --out, or move them away"
                )
            return
        old = self.finished()
        for index in old:
            self._path(index).unlink()
        try:
            earlier = json.loads(path.read_text(encoding="utf-8"))
            count = min(len(old) * int(earlier["specification"]["width"]), int(earlier["runs"]))
            self.discarded = _counted(count, "finished run")
        except (ValueError, KeyError, TypeError):  # a damaged manifest does not say how many runs a block holds
            self.discarded = _counted(len(old), "finished block")

    def _path(self, index: int) -> Path:
        return self.blocks / f"{index:06d}.nc"

    def _check(self, path: Path) -> None:
        if not path.exists():
            raise CampaignError(f"--resume: {self.folder} holds no campaign; leave --resume out to start one")
        try:
            earlier = json.loads(path.read_text(encoding="utf-8"))
            mark = earlier["fingerprint"]
        except (ValueError, KeyError, TypeError) as error:
            raise CampaignError(f"--resume: {path} is damaged ({error}); leave --resume out to start anew") from error
        if mark != self.manifest["fingerprint"]:
            changed = _differences(earlier, self.manifest)
            raise CampaignError(
                f"--resume: {self.folder} holds another campaign, different in {changed}; "
                "ask for the same one, or give another --out"
            )

    def finished(self) -> list[int]:
        """Numbers of the blocks that are whole."""
        return sorted(int(f.stem) for f in self.blocks.glob("*.nc") if re.fullmatch("[0-9]{6}|[1-9][0-9]{6,}", f.stem))

    def save(self, block: Block, experiment: Experiment) -> None:
        """Keep a finished block."""
        ds = _dataset(block, experiment)
        path = self._path(block.index)
        with replacing(path) as part:
            ds.to_netcdf(part, engine="h5netcdf")
        if ds.nbytes <= self._room:
            self._room -= ds.nbytes
            self._kept[block.index] = ds

    def load(self, indices: Iterable[int], runs: int) -> xr.Dataset | None:
        """Blocks joined along run, cut to run numbers below `runs`; None when there is none.

        A block that cannot be read is removed, so that a resume computes it again.
        """
        parts: list[xr.Dataset] = []
        for i in indices:
            if i in self._kept:
                parts.append(self._kept[i])
                continue
            path = self.blocks / f"{i:06d}.nc"
            try:
                with xr.open_dataset(path, engine="h5netcdf") as ds:
                    parts.append(ds.load())
            except (OSError, ValueError, KeyError):
                path.unlink(missing_ok=True)
        if not parts:
            return None
        parts.sort(key=lambda d: int(d["run"].values[0]))
        seconds = np.mean([p["seconds"].values for p in parts], axis=0)
        steps = parts[0].sizes["run"] * int(parts[0]["seconds"].attrs["steps"])
        results: list[xr.Dataset] = [p.drop_vars("seconds") for p in parts]
        data = xr.concat(results, "run") if len(results) > 1 else results[0]
        data["us_per_step"] = ("estimator", 1e6 * seconds / steps)
        return data.isel(run=np.flatnonzero(data["run"].values < runs))


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}" if count else ""


def _differences(earlier: dict[str, Any], now: dict[str, Any]) -> str:
    def flat(d: Any, prefix: str = "") -> dict[str, Any]:
        if not isinstance(d, dict):
            return {prefix[:-1]: d}
        return {k: v for key, value in d.items() for k, v in flat(value, f"{prefix}{key}.").items()}

    keys = ("specification", "estimators", "helmstar_version")
    a, b = ({k: v for key in keys for k, v in flat(d.get(key), f"{key}.").items()} for d in (earlier, now))
    changed = [k.removeprefix("specification.") for k in sorted(a.keys() | b.keys()) if a.get(k) != b.get(k)]
    return ", ".join(changed[:5]) or "its manifest"


def _dataset(block: Block, experiment: Experiment) -> xr.Dataset:
    names = list(block.arrays)
    variables: dict[str, Any] = {
        key: (
            ("estimator", "run", *v.dims),
            np.stack([block.arrays[n][key] for n in names]),
            dict(v.attrs),
        )
        for key, v in experiment.variables.items()
    }
    seconds = np.array([block.seconds[n] for n in names])
    variables["seconds"] = ("estimator", seconds, {"units": "s", "steps": experiment.steps})
    coords = {
        "run": block.runs,
        "time": ("time", experiment.time, {"units": "s", "long_name": "time after the start"}),
        "update": ("time", experiment.update, {"long_name": "number of the measurement, from 1"}),
        "estimator": names,
        "axis": ["x", "y", "z"],
        **experiment.coordinates,
    }
    return xr.Dataset(variables, coords)
