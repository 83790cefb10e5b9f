"""TOML configurations: reading them, and saying in plain words which key is wrong and what would be right."""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from .errors import ConfigurationError

_COMPARISONS = {"greater_than": ">", "greater_than_equal": ">=", "less_than": "<", "less_than_equal": "<="}


def read_toml(path: Path | str) -> dict[str, Any]:
    """The content of a TOML file; what cannot be read is a ConfigurationError that says where."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise ConfigurationError(f"{path}: there is no such file") from None
    except IsADirectoryError:
        raise ConfigurationError(f"{path}: this is a folder; name the TOML file in it") from None
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: not UTF-8 text (byte {error.start}); a TOML file is needed") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{path}: not valid TOML: {error}") from error
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigurationError(f"{path}: cannot be read: {error}") from error


def explain(error: ValidationError, source: str, model: type[BaseModel]) -> ConfigurationError:
    """One ConfigurationError for all that pydantic found: key, value, what is allowed, and what was probably meant.

    `source` names where the values came from (a file, `--set`), `model` is the model that was to be built.
    """
    found = [_explain_one(detail, model) for detail in error.errors(include_url=False)]
    lines = list(dict.fromkeys(found))  # a union reports one fault once per member
    return ConfigurationError("\n".join(f"{source}: {line}" for line in lines))


def _explain_one(detail: Mapping[str, Any], model: type[BaseModel]) -> str:
    location, kind, context = detail["loc"], detail["type"], detail.get("ctx", {})
    key, value = _dotted(location), _shown(detail["input"])
    if kind == "extra_forbidden":
        return f"unknown key {key!r}{_allowed_keys(location, model)}"
    if kind == "missing":
        return f"the key {key!r} is missing"
    if kind == "value_error":
        reason = str(context["error"])
        return f"{key}: {reason}" if key else reason
    if kind in _COMPARISONS:
        bound = next(iter(context.values()))
        return f"{key} = {value} is not allowed: must be {_COMPARISONS[kind]} {bound}"
    if kind in ("literal_error", "enum"):
        word = detail["input"]
        close = _did_you_mean(
            word if isinstance(word, str) else "",
            context["expected"].replace("'", "").replace(" or ", ", ").split(", "),
        )
        return f"{key} = {value} is not allowed{close}: must be {context['expected']}"
    if kind in ("too_short", "too_long"):
        expected = context.get("min_length", context.get("max_length"))
        relation = "at least" if kind == "too_short" else "at most"
        return (
            f"{key} = {value} is not allowed: must have {relation} {expected} entries, has {context['actual_length']}"
        )
    if kind in ("model_type", "dict_type"):
        return f"{key} = {value} is not allowed: must be a table of keys"
    reason = detail["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    return f"{key} = {value} is not allowed: must be {reason}"


def _allowed_keys(location: tuple[int | str, ...], model: type[BaseModel]) -> str:
    """What to say after an unknown key: the one probably meant, and all keys of its table."""
    holders = [model]
    for part in location[:-1]:
        inner = [m for holder in holders for m in _models_of(holder, part)]
        holders = inner or holders  # list indices and the tags of unions are no fields
    names = sorted({field.alias or name for holder in holders for name, field in holder.model_fields.items()})
    return f"{_did_you_mean(str(location[-1]), names)}; allowed here: {', '.join(names)}"


def _models_of(model: type[BaseModel], key: int | str) -> Iterator[type[BaseModel]]:
    for name, field in model.model_fields.items():
        if key in (name, field.alias):
            yield from _models_in(field.annotation)


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)


def _did_you_mean(word: str, words: list[str]) -> str:
    close = difflib.get_close_matches(word, words, n=1, cutoff=0.6)
    return f" (did you mean {close[0]!r}?)" if close else ""


def _dotted(location: tuple[int | str, ...]) -> str:
    return ".".join(str(part) if isinstance(part, str) else f"[{part}]" for part in location).replace(".[", "[")


def _shown(value: Any) -> str:
    """A value as TOML would show it, cut where it is long."""
    if isinstance(value, BaseModel):
        value = value.model_dump()
    try:
        text = json.dumps(value, default=str)
    except (ValueError, RecursionError):  # an integer of thousands of digits, thousands of tables in each other
        return "a value too long to show"
    return text if len(text) <= 80 else text[:77] + "..."
