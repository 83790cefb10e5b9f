"""What every scenario file has, and how a file and `--set` become a validated specification.

A scenario is a TOML file that names its `experiment`. The library's file of that experiment gives every key; a user's own
file and then `--set` override single ones.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ..configuration import explain, read_toml
from ..errors import ConfigurationError

DEEPEST = 8
"""More dots than any key of a scenario has."""


class ScenarioSpecification(BaseModel):
    """The keys that all scenarios share."""

    model_config = ConfigDict(extra="forbid", strict=True)

    experiment: str
    title: str
    runs: Annotated[int, Field(ge=1, le=10_000_000)]
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)]
    width: Annotated[int, Field(ge=2, le=4096)]

    @classmethod
    def adapted(cls, content: Mapping[str, Any], stated: Mapping[str, Any]) -> Mapping[str, Any]:
        """The content of a file and of `--set`, with defaults that depend on it; `stated`: what the user said himself."""
        return content

    @property
    def note(self) -> str:
        """What the user should know before it starts; empty for nothing."""
        return ""


def library() -> dict[str, str]:
    """The built-in scenarios: name -> TOML text."""
    folder = resources.files("helmstar.scenarios") / "library"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=lambda f: f.name)
    return {f.name.removesuffix(".toml"): f.read_text(encoding="utf-8") for f in files}


def parse_set(assignments: Iterable[str]) -> dict[str, Any]:
    """`["star.sigma_arcsec=20"]` -> {"star.sigma_arcsec": 20}; values are TOML, a bare word is a string.

    Raises ConfigurationError for what is not one KEY=VALUE, and for a key given twice or inside another that is given.
    """
    out: dict[str, Any] = {}
    for text in assignments:
        key, equals, value = text.partition("=")
        key = key.strip()
        if not equals or not key:
            raise ConfigurationError(f"--set {text}: must be KEY=VALUE, such as --set star.sigma_arcsec=20")
        if key.count(".") > DEEPEST:
            raise ConfigurationError(f"--set {_cut(text)}: no key has that many dots")
        same = next((k for k in out if f"{k}.".startswith(f"{key}.") or f"{key}.".startswith(f"{k}.")), None)
        if same is not None:
            what = f"{key} is given twice" if same == key else f"{same} and {key} set the same thing"
            raise ConfigurationError(f"--set {_cut(text)}: {what}; give one of them")
        try:
            found = tomllib.loads(f"v = {value}")
        except tomllib.TOMLDecodeError:
            found = {"v": value.strip()}
        except (ValueError, RecursionError) as error:  # thousands of digits or brackets
            raise ConfigurationError(f"--set {_cut(text)}: cannot be read: {error}") from None
        if found.keys() != {"v"}:
            raise ConfigurationError(f"--set {_cut(text)}: must be one KEY=VALUE; give --set once for each key")
        out[key] = found["v"]
    return out


def _cut(text: str) -> str:
    """On one line, at most 60 characters."""
    shown = text.encode("unicode_escape").decode() if not text.isprintable() else text
    return shown if len(shown) <= 60 else shown[:57] + "..."


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with the keys of `over` put in, tables merged key by key."""
    out = dict(base)
    for key, value in over.items():
        mine = out.get(key)
        out[key] = merge(mine, value) if isinstance(mine, Mapping) and isinstance(value, Mapping) else value
    return out


def _nested(dotted: Mapping[str, Any]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in dotted.items():
        parts = key.split(".")
        piece: Any = value
        for part in reversed(parts):
            piece = {part: piece}
        out = merge(out, piece)
    return out


def _content(scenario: str) -> tuple[str, str, dict[str, Any], dict[str, Any]]:
    """Name, source for messages, and content of a library scenario or of a user's file; and what of it is the user's."""
    built_in = library()
    if scenario in built_in:
        return scenario, f"scenario {scenario}", tomllib.loads(built_in[scenario]), {}
    path = Path(scenario)
    if path.suffix != ".toml" and not path.exists():
        names = ", ".join(built_in)
        raise ConfigurationError(f"scenario {scenario!r}: no such scenario; there are {names}, or give a .toml file")
    content = read_toml(path)
    experiment = content.get("experiment")
    if not isinstance(experiment, str) or experiment not in built_in:
        given = repr(experiment) if isinstance(experiment, str) or experiment is None else "a value that is no text"
        raise ConfigurationError(
            f"{path}: experiment = {given} is not allowed: must be one of {', '.join(map(repr, built_in))}"
        )
    return path.stem, str(path), merge(tomllib.loads(built_in[experiment]), content), content


def validate(model: type[BaseModel], content: Mapping[str, Any], source: str) -> Any:
    """The specification; a ConfigurationError names every wrong key, its value and what is allowed."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise explain(error, source, model) from None


def load(scenario: str, overrides: Mapping[str, Any] | None = None) -> tuple[str, Any]:
    """Name and validated specification of a scenario by library name or file, with dotted keys overridden.

    Raises ConfigurationError for an unknown scenario, key or value.
    """
    name, source, content, stated = _content(scenario)
    model: type[ScenarioSpecification] = specification_of(content["experiment"])
    validate(model, content, source)
    if overrides:
        given = _nested(overrides)
        content, stated, source = merge(content, given), merge(stated, given), "--set"
    return name, validate(model, model.adapted(content, stated), source)


def specification_of(experiment: str) -> type[ScenarioSpecification]:
    """The pydantic model of an experiment. This is the one list of experiments beside `build`."""
    if experiment == "xu2020":
        from .xu2020_specification import Specification

        return Specification
    if experiment == "zhou2021":
        from .zhou2021_specification import Specification

        return Specification
    if experiment == "li2007":
        from .li2007_specification import Specification

        return Specification
    if experiment == "approach":
        from .approach_specification import Specification

        return Specification
    raise ConfigurationError(f"experiment {experiment!r}: must be one of {', '.join(library())}")


def build(name: str, specification: Any, workers: int = 1) -> Any:
    """The experiment of a specification, ready to run (this loads JAX); workers: processes where it takes frames."""
    if specification.experiment == "xu2020":
        from .xu2020 import Experiment

        return Experiment(specification, name, workers)
    if specification.experiment == "zhou2021":
        from .zhou2021 import Experiment

        return Experiment(specification, name)
    if specification.experiment == "li2007":
        from .li2007 import Experiment

        return Experiment(specification, name, workers)
    if specification.experiment == "approach":
        from .approach import Experiment

        return Experiment(specification, name)
    raise ConfigurationError(f"experiment {specification.experiment!r}: must be one of {', '.join(library())}")
