"""One self-contained HTML page: prose, tables, verdict chips, interactive figures; opens offline, asks no network.

    page = Page("Attitude campaign", subtitle="100 runs")
    page.section("Result", "All runs converge.")
    page.table([Column("Estimator", align="left"), Column("RMS", "deg")], [["lie", 0.0031]], caption="At the end.")
    page.figure(figure, caption="The error stays inside the band.")
    page.write(Path("report.html"))

Text is plain text, escaped here; `backticks` mark code. A figure is a dict of plotly's figure JSON in the light palette
(style.py); page.js draws it in light or dark. `layout.meta` may hold "views" (label -> layout changes, as buttons) and
"note" (a sentence below the caption). A content security policy forbids the page to load anything.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..errors import HelmstarError
from ..files import write_atomically
from .encode import ArrayPool, pack, script_json

ChipKind = Literal["good", "bad", "part", "plain"]
_SIGNS = {"good": "✓", "bad": "✗", "part": "◐", "plain": "•"}
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; "
    "base-uri 'none'; form-action 'none'"
)


@dataclass(frozen=True)
class Chip:
    """A short verdict: colour, sign and word."""

    kind: ChipKind
    text: str


@dataclass(frozen=True)
class Column:
    """A column of a table; numbers stand on the right, in `digits` significant digits."""

    title: str
    unit: str = ""
    align: Literal["left", "right"] = "right"
    digits: int = 3


@dataclass(frozen=True)
class Figure:
    """A figure with its caption; `figure` is one plotly dict, or several by name for a selector.

    Figures with the same `group` on one page follow one another's selector. `selected` is the variant shown first.
    """

    figure: Mapping[str, Any]
    caption: str
    alt: str = ""
    height: int = 380
    select: str = ""
    selected: str = ""
    group: str = ""

    def variants(self) -> Mapping[str, Mapping[str, Any]]:
        """The figures by name; the name is empty where there is only one."""
        return self.figure if self.select else {"": self.figure}

    def first(self) -> str:
        """The name of the variant shown first."""
        names = list(self.variants())
        return self.selected if self.selected in names else names[0]


Cell = Any  # str, number, None, Chip, or a tuple of these: the first large, the rest small below it


@dataclass
class Page:
    """Builder of one page; its methods add to the end of the current section."""

    title: str
    subtitle: str = ""
    footer: str = "Written by helmstar. This page is complete in itself: it loads nothing and sends nothing."
    _body: list[str] = field(default_factory=list)
    _contents: list[tuple[str, str]] = field(default_factory=list)
    _figures: list[dict[str, Any]] = field(default_factory=list)
    _tables: int = 0
    _pool: ArrayPool = field(default_factory=ArrayPool)

    def headline(self, text: str, *more: str) -> None:
        """The result in one sentence, large; more sentences below it in normal size."""
        self._body.append(f'<p class="headline">{_inline(text)}</p>')
        self.prose(*more)

    def section(self, title: str, *paragraphs: str, short: str = "") -> None:
        """Start a section; `short` is its name in the table of contents."""
        if self._contents:
            self._body.append("</section>")
        anchor = _anchor(title, {known for known, _ in self._contents})
        self._contents.append((anchor, short or title))
        self._body.append(f'<section id="{anchor}" aria-labelledby="{anchor}-title">')
        self._body.append(f'<h2 id="{anchor}-title">{escape(title)}</h2>')
        self.prose(*paragraphs)

    def heading(self, title: str) -> None:
        """A heading within a section."""
        self._body.append(f"<h3>{escape(title)}</h3>")

    def prose(self, *paragraphs: str) -> None:
        """Paragraphs of plain text."""
        self._body.extend(f"<p>{_inline(text)}</p>" for text in paragraphs if text)

    def notice(self, text: str) -> None:
        """A paragraph that must not be overlooked."""
        self._body.append(f'<p class="notice" role="note">{_inline(text)}</p>')

    def table(
        self, columns: Sequence[Column], rows: Sequence[Sequence[Cell]], caption: str = "", cards: bool = False
    ) -> None:
        """A table; on a phone it scrolls in its own box or, with `cards`, every row becomes a card."""
        heads = "".join(
            f'<th scope="col" role="columnheader" class="{column.align}">{escape(column.title)}'
            + (f' <span class="unit">{escape(column.unit)}</span>' if column.unit else "")
            + "</th>"
            for column in columns
        )
        lines = []
        for row in rows:
            cells = [_cell(column, value, i == 0) for i, (column, value) in enumerate(zip(columns, row, strict=True))]
            lines.append('<tr role="row">' + "".join(cells) + "</tr>")
        self._tables += 1
        name = f"table-{self._tables}"  # the caption stays outside, where it does not scroll away with the table
        title = f'<p class="caption" id="{name}">{_inline(caption)}</p>' if caption else ""
        label = f'aria-labelledby="{name}"' if caption else 'aria-label="Table"'
        self._body.append(
            f'{title}<div class="scroll{" cards" if cards else ""}" tabindex="0" role="region" {label}>'
            f'<table role="table" {label}><thead role="rowgroup"><tr role="row">{heads}</tr></thead>'
            f'<tbody role="rowgroup">{"".join(lines)}</tbody></table></div>'
        )

    def figure(self, figure: Mapping[str, Any] | Figure, caption: str = "", **options: Any) -> None:
        """One figure, as wide as the page; `options` as in `Figure`."""
        self.figures([figure if isinstance(figure, Figure) else Figure(figure, caption, **options)])

    def figures(self, figures: Sequence[Figure]) -> None:
        """Figures side by side where the screen is wide enough, below one another on a phone."""
        parts = [self._figure(item) for item in figures]
        self._body.append(f'<div class="figures{" alone" if len(parts) == 1 else ""}">{"".join(parts)}</div>')

    def code(self, text: str, label: str = "") -> None:
        """A block of code with a button that copies it."""
        self._body.append(
            f'<div class="code"><div class="bar"><span class="label">{escape(label)}</span><button type="button" '
            f'class="copy">Copy</button></div><pre tabindex="0"><code>{escape(text)}</code></pre></div>'
        )

    @contextmanager
    def details(self, summary: str, opened: bool = False) -> Iterator[None]:
        """A block that the reader opens: what is added inside `with` goes into it."""
        self._body.append(f"<details{' open' if opened else ''}><summary>{_inline(summary)}</summary>")
        yield
        self._body.append("</details>")

    def html(self) -> str:
        """The whole page."""
        body = [*self._body, "</section>"] if self._contents else self._body
        links = "".join(f'<li><a href="#{anchor}">{escape(name)}</a></li>' for anchor, name in self._contents)
        contents = f'<nav class="contents" aria-label="Contents"><ol>{links}</ol></nav>' if links else ""
        subtitle = f'<p class="subtitle">{_inline(self.subtitle)}</p>' if self.subtitle else ""
        content = "\n".join(body)
        return "".join(
            [
                '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n',
                f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n',
                '<meta name="viewport" content="width=device-width, initial-scale=1">\n',
                '<meta name="color-scheme" content="light dark"><link rel="icon" href="data:,">\n',
                f"<title>{escape(self.title)}</title>\n<style>{_asset('page.css')}</style></head>\n<body>",
                f"<header><h1>{escape(self.title)}</h1>{subtitle}</header>\n",
                '<noscript><p class="notice">The plots need JavaScript; text and tables are complete.</p></noscript>',
                f'<div class="columns">{contents}\n<main>{content}</main></div>\n',
                f"<footer><p>{_inline(self.footer)}</p></footer>\n",
                f'<script type="application/json" id="page-data">{self._data()}</script>\n' if self._figures else "",
                f"<script>{_plotly()}</script>\n" if self._figures else "",
                f"<script>{_asset('page.js')}</script>\n</body></html>\n",
            ]
        )

    def write(self, path: Path) -> Path:
        """Write the page; a reader sees the old file or the whole new one, never a part."""
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        return write_atomically(target, self.html())

    def _figure(self, item: Figure) -> str:
        variants, first = item.variants(), item.first()
        index = len(self._figures)
        packed = [{"name": name, **pack(dict(figure), self._pool)} for name, figure in variants.items()]
        self._figures.append({"group": item.group, "height": item.height, "variants": packed})
        select = ""
        if item.select:
            options = "".join(
                f"<option{' selected' if name == first else ''}>{escape(name)}</option>" for name in variants
            )
            select = f'<label class="select">{escape(item.select)} <select>{options}</select></label>'
        note = (variants[first].get("layout", {}).get("meta") or {}).get("note", "")
        return (
            f'<figure class="figure" data-figure="{index}"><div class="controls">{select}<div class="views" '
            f'role="group" aria-label="View"></div></div><div class="plot" role="img" '
            f'aria-label="{escape(item.alt or item.caption, quote=True)}" style="height:{item.height}px"></div>'
            f'<div class="legend"></div><figcaption>{_inline(item.caption)}'
            f' <span class="note" aria-live="polite">{escape(note)}</span></figcaption></figure>'
        )

    def _data(self) -> str:
        return script_json({"arrays": self._pool.entries, "figures": self._figures})


def number(value: Any, digits: int = 3) -> str:
    """A number for people: 0.0031, 12 345, 3.5×10⁻⁶; a dash where there is none."""
    if value is None or not np.isfinite(value):
        return "–"
    if isinstance(value, (int, np.integer)):
        return f"{value:,}".replace(",", "\u202f").replace("-", "−")
    text = f"{value:.{digits}g}"
    if "e" not in text:
        return text.replace("-", "−")
    mantissa, exponent = text.split("e")
    if 0 <= int(exponent) < 7:
        return f"{value:,.0f}".replace(",", "\u202f").replace("-", "−")
    power = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{mantissa}×10{power}".replace("-", "−")


def _cell(column: Column, value: Cell, first: bool) -> str:
    parts = value if isinstance(value, tuple) else (value,)
    large = _content(parts[0], column.digits)
    small = "".join(f'<span class="small">{_content(part, column.digits)}</span>' for part in parts[1:] if part)
    label = f'data-label="{escape(column.title, quote=True)}"'
    if first:
        large = re.sub(r"_(?=\w)", "_<wbr>", large)  # names of estimators may break there
        return f'<th scope="row" role="rowheader" class="{column.align}" {label}>{large}{small}</th>'
    return f'<td role="cell" class="{column.align}" {label}><div>{large}{small}</div></td>'


def _content(value: Cell, digits: int) -> str:
    if isinstance(value, Chip):
        sign = f'<span aria-hidden="true">{_SIGNS[value.kind]}</span>'
        return f'<span class="chip {value.kind}">{sign} {escape(value.text)}</span>'
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or isinstance(value, (int, float, np.integer, np.floating)):
        return number(value, digits)
    return _inline(str(value))


def _inline(text: str) -> str:
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))


def _anchor(title: str, taken: set[str]) -> str:
    base = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-") or "section"
    anchor, count = base, 2
    while anchor in taken:
        anchor, count = f"{base}-{count}", count + 1
    return anchor


def _asset(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def _plotly() -> str:
    spec = importlib.util.find_spec("plotly")  # finds the package without importing it
    if spec is None or spec.origin is None:
        raise HelmstarError("the report needs the package plotly, which is not installed: pip install plotly")
    return (Path(spec.origin).parent / "package_data" / "plotly.min.js").read_text(encoding="utf-8")
