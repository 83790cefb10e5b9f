"""A paper's claims beside what was found, and the words and signs of a verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from .page import Chip, ChipKind, Column, Page

Verdict = Literal["holds", "does not hold", "holds in part", "measured"]

_KINDS: dict[str, ChipKind] = {
    "holds": "good",
    "does not hold": "bad",
    "holds in part": "part",
    "measured": "plain",
}


@dataclass(frozen=True)
class Claim:
    """A paper's claim: what it says and where, what the printed and the consistent equations give, the bound."""

    claim: str
    source: str
    printed: str
    consistent: str
    bound: str
    verdict: Verdict
    explanation: str

    def __post_init__(self) -> None:
        if self.verdict not in _KINDS:
            raise ValueError(f"a verdict is one of {', '.join(_KINDS)}, not {self.verdict!r}")


def verdict_chip(verdict: str) -> Chip:
    """The verdict as a chip: colour, sign and word, so that none of them is needed alone."""
    return Chip(_KINDS.get(verdict, "plain"), verdict)


def add_claims(page: Page, claims: Sequence[Claim]) -> None:
    """The table of claims; on a phone every claim becomes a card."""
    columns = [
        Column("Claim", align="left"),
        Column("Printed equations give", align="left"),
        Column("Consistent form gives", align="left"),
        Column("Bound", align="left"),
        Column("Verdict", align="left"),
        Column("Why", align="left"),
    ]
    rows = [
        [(c.claim, c.source), c.printed, c.consistent, c.bound, verdict_chip(c.verdict), c.explanation] for c in claims
    ]
    page.table(columns, rows, caption="Every claim of the paper, as it was found here.", cards=True)
