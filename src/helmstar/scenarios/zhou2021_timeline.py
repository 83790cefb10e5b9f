"""The passes of a zhou2021 run as one timeline: the main pass, and after it branches that begin where they are told.

A branch goes over a stretch of the same data again: with the gyro lost and bridged by one policy, with the stars lost, from a
wrong start, or after an upset. As one sequence they cost one compiled program, and the steps before a branch are
computed once.

| branch | begins | what happens |
|---|---|---|
| none | at gyro.loss_start_s, with the main pass's belief of then | nothing: what the peaks of the others compare with |
| zeros, hold_last, ... | there | gyro lost for gyro.loss_s |
| both_lost | there | gyro lost, bridged by hold_mean, and all stars lost for gyro.loss_s too, whatever star.loss_s is |
| star_loss | there | all stars lost for STAR_LOSS_S |
| upset_90deg | there | the body is turned by 90 deg between two steps without the gyro's noticing |
| start_* | at 0 s | wrong attitude, and wrong drift where a number of deg/h is given |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .zhou2021_specification import POLICIES, Specification

AFTER_LOSS_S = 10
STAR_LOSS_S = 300
AFTER_STAR_LOSS_S = 150
RECOVERY_S = 300
CONTINUE, FROM_SAVED, FROM_WRONG = range(3)
CODES = {"none": 0, **{name: i for i, name in enumerate(POLICIES, start=1)}}
CASES = {
    "start_90deg": (90.0, 0.0),
    "start_150deg": (150.0, 0.0),
    "start_179deg": (179.0, 0.0),
    "start_179deg_1000deg_h": (179.0, 1000.0),
}
"""Wrong starts: attitude error in deg, drift in deg/h that the filter is not told."""
UPSET = "upset_90deg"


@dataclass(frozen=True)
class Branch:
    """Steps [start, start + count) of the timeline; `kind`: "policy", "star_loss" or "recovery"."""

    name: str
    kind: str
    start: int
    count: int


@dataclass(frozen=True)
class Timeline:
    """Arrays (steps,): index of the second that a step covers; policy code; stars lost; how the step begins, with the turn
    (rad) made there; drift (rad/s) added to the gyro; save: keep the belief after this step for the branches."""

    main: int
    branches: tuple[Branch, ...]
    index: np.ndarray
    policy: np.ndarray
    dark: np.ndarray
    begin: np.ndarray
    turn: np.ndarray
    offset: np.ndarray
    save: np.ndarray

    @property
    def steps(self) -> int:
        """Of all passes together."""
        return len(self.index)

    def of(self, kind: str) -> tuple[Branch, ...]:
        """The branches of one kind."""
        return tuple(b for b in self.branches if b.kind == kind)


def build_timeline(spec: Specification) -> Timeline:
    """All passes that the scenario's duration has room for."""
    n = spec.duration_s
    at, loss = spec.gyro.loss_start_s, spec.gyro.loss_s
    pieces: list[tuple[str, str, dict[str, np.ndarray]]] = []

    def piece(start: int, count: int, **more: object) -> dict[str, np.ndarray]:
        index = np.arange(start, start + count)
        out = {
            "index": index,
            "policy": np.zeros(count, int),
            "dark": np.zeros(count, bool),
            "begin": np.zeros(count, int),
            "turn": np.zeros(count),
            "offset": np.zeros(count),
        }
        for key, value in more.items():
            out[key][:] = value
        return out

    lost = {at + k for k in range(loss)}
    main = piece(0, n)
    in_loss = np.isin(main["index"], list(lost))
    main["policy"] = np.where(in_loss, CODES[spec.gyro.loss_policy], 0)
    main["dark"] = (main["index"] >= spec.star.loss_start_s) & (
        main["index"] < spec.star.loss_start_s + spec.star.loss_s
    )

    def branch(name: str, kind: str, count: int, **more: object) -> None:
        if at + count > n:
            return
        p = piece(at, count, **more)
        p["begin"][0] = FROM_SAVED
        pieces.append((name, kind, p))

    during = np.arange(loss + AFTER_LOSS_S) < loss
    for name in ("none", *POLICIES):
        branch(name, "policy", len(during), policy=np.where(during, CODES[name], 0))
    branch("both_lost", "policy", len(during), policy=np.where(during, CODES["hold_mean"], 0), dark=during)
    dark = np.arange(STAR_LOSS_S + AFTER_STAR_LOSS_S) < STAR_LOSS_S
    branch("star_loss", "star_loss", len(dark), dark=dark)
    first = np.arange(RECOVERY_S) == 0
    branch(UPSET, "recovery", RECOVERY_S, turn=np.where(first, np.pi / 2, 0.0))
    for name, (error_deg, drift_deg_h) in CASES.items():
        if n < RECOVERY_S:
            continue
        p = piece(0, RECOVERY_S, offset=np.deg2rad(drift_deg_h) / 3600.0)
        p["begin"][0], p["turn"][0] = FROM_WRONG, np.deg2rad(error_deg)
        pieces.append((name, "recovery", p))
    branches, start = [], n
    for name, kind, p in pieces:
        branches.append(Branch(name, kind, start, len(p["index"])))
        start += len(p["index"])
    whole = {k: np.concatenate([main[k], *(p[k] for _, _, p in pieces)]) for k in main}
    save = np.zeros(start, bool)
    if at <= n:
        save[at - 1] = True
    return Timeline(n, tuple(branches), save=save, **whole)
