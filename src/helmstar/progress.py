"""Progress with the time left, on stderr, for whatever may take over two seconds."""

from __future__ import annotations

import sys
from typing import Any


class Progress:
    """rich's progress bar on stderr, or silence."""

    def __init__(self, on: bool):
        self._bar: Any = None
        if on:
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
            from rich.progress import Progress as RichProgress

            columns = (
                TextColumn("{task.description:<24}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeRemainingColumn(),
            )
            self._bar = RichProgress(*columns, console=Console(file=sys.stderr))

    def __enter__(self) -> Progress:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar:
            self._bar.stop()

    def add(self, what: str, total: int) -> Any:
        return self._bar.add_task(what, total=total) if self._bar else None

    def advance(self, task: Any) -> None:
        if self._bar:
            self._bar.advance(task)

    def finish(self, task: Any) -> None:
        if self._bar:
            self._bar.update(task, completed=self._bar.tasks[task].total)
