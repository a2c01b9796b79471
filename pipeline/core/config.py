"""Strict configuration: a table of plain values becomes a frozen dataclass, or an `InputError`.

A stage declares `Config`; the recipe's table for that stage is checked against it: unknown keys and values
of a wrong type are refused with a list of what is known. Standard library only.
"""

import dataclasses
import json
import math
import reprlib
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pipeline.core.errors import InputError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

LARGEST_INTEGER = (1 << 63) - 1
"""64 bits, as TOML guarantees; larger ones may not fit a float either."""
NEVER_ZERO = ("_hz", "_px", "_size", "batch", "epochs", "stride", "trials")
"""Endings of keys of rates, sizes and numbers that nothing can be made with none of."""
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxlong, _SHORT.maxstring, _SHORT.maxother = 4, 40, 100, 200
_SHORT.maxtuple = _SHORT.maxlist = _SHORT.maxdict = 20
"""Limits of a value in a message: files may hold numbers of thousands of digits and deeply nested tables."""


C = TypeVar("C", bound="DataclassInstance")


def read_table(path: Path) -> dict[str, Any]:
    """Read a JSON (`.json`) or TOML file that holds one table."""
    try:
        text = path.read_text("utf-8-sig")
        table = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise InputError("REC-003", f"cannot be read: {error}", str(path), "repair the file") from error
    if not isinstance(table, dict):
        raise InputError("REC-003", "does not hold a table", str(path), "write `key = value` lines")
    return table


def from_table(config: type[C], table: Mapping[str, Any], *, where: str, base: C | None = None) -> C:
    """Check `table` against the fields of the dataclass `config` and build it; nested tables likewise.

    Missing keys are taken from `base`, else from the field's default. Raises `InputError` REC-001
    (unknown key), REC-002 (wrong type, impossible or missing value).
    """
    fields = {field.name: field for field in dataclasses.fields(config)}
    refuse_unknown(table, fields, where=where)
    hints = typing.get_type_hints(config)
    values = (
        vars(base).copy()
        if base is not None
        else {
            name: field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
            for name, field in fields.items()
        }
    )
    for key, value in table.items():
        checked = _checked(hints[key], value, f"{where}: {key}", values[key])
        refuse_impossible(value, values[key], where=f"{where}: {key}")
        values[key] = checked
    for key, value in values.items():
        if value is dataclasses.MISSING:
            raise InputError("REC-002", f"{key!r} is missing", where, f"give a value of type {hints[key]}")
    return config(**values)


def refuse_unknown(
    table: Mapping[str, Any], known: typing.Collection[str], *, where: str, kind: str = "key"
) -> None:
    """Raise REC-001, listing the known keys, if `table` has a key outside `known`."""
    for key in table:
        if key not in known:
            remedy = f"known: {', '.join(sorted(known)) or 'none'}"
            raise InputError("REC-001", f"unknown {kind} {shown(key)}", where, remedy)


def refuse_impossible(value: Any, default: Any, *, where: str) -> None:
    """Raise REC-002 for non-finite numbers, unexpected negative ones, and a `NEVER_ZERO` of 0."""
    if not isinstance(default, int | float | tuple):
        return
    remedy = f"give a number as the default is, {default!r}"
    for item in value if isinstance(value, list | tuple) else [value]:
        if isinstance(item, float) and not math.isfinite(item):
            raise InputError("REC-002", f"{shown(value)} cannot be", where, remedy)
    if not isinstance(value, int | float) or isinstance(default, tuple):
        return
    zero_size = where.endswith(NEVER_ZERO) and value == 0
    non_negative = default > 0 or (default == 0 and isinstance(default, int))
    if (non_negative and value < 0) or (default > 0 and zero_size):
        raise InputError("REC-002", f"{shown(value)} cannot be", where, remedy)


def shown(value: Any) -> str:
    """Return a value's `repr` for a message, truncated if long or deeply nested."""
    return _SHORT.repr(value)


def _checked(hint: Any, value: Any, where: str, default: Any = None) -> Any:
    """Convert `value` to the type `hint` (lists to tuples, integers to floats) or raise REC-002."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
        raise InputError("REC-002", f"{shown(value)} is too large", where, f"{LARGEST_INTEGER} at most")
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        if not isinstance(value, Mapping):
            known = ", ".join(sorted(field.name for field in dataclasses.fields(hint)))
            raise InputError("REC-002", f"{shown(value)} is no table", where, f"keys in it: {known}")
        return from_table(hint, value, where=where, base=default if isinstance(default, hint) else None)
    if origin is typing.Literal and value in arguments:
        return value
    if origin in (typing.Union, types.UnionType):
        return _first_fitting(arguments, value, hint, where)
    if origin is tuple and isinstance(value, (list, tuple)):
        each = [arguments[0]] * len(value) if arguments[1:] == (...,) else list(arguments)
        if len(each) == len(value):
            pairs = enumerate(zip(each, value, strict=True))
            return tuple(_checked(kind, item, f"{where}[{i}]") for i, (kind, item) in pairs)
    if origin is dict and isinstance(value, Mapping):
        return {key: _checked(arguments[1], item, f"{where}.{key}") for key, item in value.items()}
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if origin is None and isinstance(hint, type) and type(value) is hint:
        return value
    if hint in (None, types.NoneType) and value is None:
        return None
    expected = str(hint).replace("typing.", "")
    if isinstance(hint, type) and origin is None:
        expected = hint.__name__
    what, remedy = f"{shown(value)} is not {expected}", f"give a value of type {expected}"
    raise InputError("REC-002", what, where, remedy)


def _first_fitting(kinds: tuple[Any, ...], value: Any, hint: Any, where: str) -> Any:
    for kind in kinds:
        try:
            return _checked(kind, value, where)
        except InputError:
            continue
    raise InputError("REC-002", f"{shown(value)} is not {hint}", where, f"give a value of type {hint}")
