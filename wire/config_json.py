"""Configurations as JSON and back: frozen dataclasses, typed field by field.

Between the dataclasses of `wire.run_config` and the pipes, files and recordings that carry them. A field with
"missing" in its metadata may be missing, as in older recordings; that is its value then. And numbers for JSON
of any other kind: `finite`.
"""

from __future__ import annotations

import base64
import dataclasses
import json
import math
import types
import typing
from typing import Any, TypeVar

from wire.errors import UsageError, shown

T = TypeVar("T")


def dumps(config: Any) -> str:
    """A configuration as one line of JSON; bytes become {"base64": text}."""
    data = dataclasses.asdict(config)
    return json.dumps(data, separators=(",", ":"), allow_nan=False, default=_bytes_out)


def finite(value: Any) -> Any:
    """The same data with None for every number that is not finite: JSON has no other word for it."""
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _bytes_out(value: Any) -> dict[str, str]:
    if not isinstance(value, bytes):
        raise TypeError(f"{type(value).__name__} has no place in a configuration")
    return {"base64": base64.b64encode(value).decode()}


def _bytes_in(data: dict[str, Any]) -> Any:
    if data.keys() == {"base64"}:
        return base64.b64decode(data["base64"], validate=True)
    return data


def loads(cls: type[T], text: str | bytes, where: str) -> T:
    """A configuration from JSON; UsageError names the field that is missing, unknown or of a wrong
    type."""
    try:
        data = json.loads(text, object_hook=_bytes_in)
    except (ValueError, TypeError, RecursionError) as error:
        raise UsageError(f"{where}: not JSON ({error})") from None
    return typing.cast(T, _build(cls, data, where))


def _build(cls: Any, data: Any, where: str) -> Any:
    if not isinstance(data, dict):
        raise UsageError(f"{where}: expected an object, got {type(data).__name__}")
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        if "missing" in field.metadata:
            data = {field.name: field.metadata["missing"], **data}
    if missing := sorted(hints.keys() - data.keys()):
        raise UsageError(f"{where}: {missing[0]} is missing")
    if unknown := sorted(data.keys() - hints.keys()):
        raise UsageError(f"{where}: {unknown[0]!r} is not a known field")
    values = {key: _value(hints[key], data[key], f"{where}.{key}") for key in hints if key in data}
    try:
        return cls(**values)
    except UsageError as error:  # it names the field
        raise UsageError(f"{where}.{error}") from None


def _value(hint: Any, data: Any, where: str) -> Any:
    origin = typing.get_origin(hint)
    if dataclasses.is_dataclass(hint):
        return _build(hint, data, where)
    if origin in (typing.Union, types.UnionType):
        if data is None:
            return None
        return _value(next(a for a in typing.get_args(hint) if a is not type(None)), data, where)
    if origin is tuple:
        if not isinstance(data, list):
            raise UsageError(f"{where}: expected a list, got {type(data).__name__}")
        inner = typing.get_args(hint)[0]
        return tuple(_value(inner, item, f"{where}[{i}]") for i, item in enumerate(data))
    if origin is dict:
        if not isinstance(data, dict):
            raise UsageError(f"{where}: expected an object, got {type(data).__name__}")
        inner = typing.get_args(hint)[1]
        return {
            _value(str, k, f"{where}, a name"): _value(inner, v, f"{where}.{k}")
            for k, v in data.items()
        }
    if hint is Any:
        return data
    if hint is float and type(data) is int:
        try:
            data = float(data)
        except OverflowError:
            data = math.inf if data > 0 else -math.inf
    if type(data) is not hint:
        raise UsageError(f"{where}: expected {hint.__name__}, got {shown(data)}")
    if hint is float and not math.isfinite(data):
        raise UsageError(f"{where}: expected a finite number, got {data!r}")
    if hint is str:
        try:
            data.encode(errors="surrogateescape")  # which a file's name may need
        except UnicodeEncodeError:  # half a surrogate pair, that no other reader of JSON takes
            raise UsageError(f"{where}: expected text, got {shown(data)}") from None
    return data
