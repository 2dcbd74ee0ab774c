"""Damage to what is valid, as hypothesis strategies for bytes, text files and JSON: what fails shrinks to the
smallest damage."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from typing import Any, TypeVar

from hypothesis import settings
from hypothesis import strategies as st

T = TypeVar("T")
DEEP = "[" * 1200 + "]" * 1200
"""Nested more deeply than Python's stack is."""
_DEEP_MARK = "@deep@"
_SIZES = (0, 1, 0x7F, 0xFF, 0xFFFF, 0x7FFF_FFFF, 0xFFFF_FFFF, 2**40, 2**63 - 1, 2**64 - 1)
NUMBERS: tuple[Any, ...] = (
    *(0, -1, 1, 2, 7, 2**31, 2**53, 2**53 + 1, 2**63 - 1, 2**63, 2**64, 10**400, -(10**400)),
    *(0.0, -0.0, 5e-324, 1e-300, 1e300, 1.7e308, -1e308, 0.1, math.nan, math.inf, -math.inf),
)
ODD: tuple[Any, ...] = (
    *(None, True, False, "", "\x00", "\ud800", "é\u202e\n", "a" * 5000, "nan", "1"),
    *(
        [],
        {},
        [[]],
        [None],
        {"": 0},
        {"base64": ""},
        {"base64": "AAAAAAAA"},
        {"base64": 1},
        _DEEP_MARK,
    ),
)
"""Values of other types than the one that stands there, or out of every range."""
TOKENS = (
    *("nan", "inf", "-inf", "1e308", "-1e308", "5e-324", "-0.0", "0", "-1", "1", "1e400", "9" * 30),
    *(
        "9" * 5000,
        "0." + "3" * 5000,
        "0x" + "f" * 5000,
        "1_0",
        "0o17",
        "true",
        "false",
        '""',
        "[]",
        "{}",
    ),
    *(
        '"\\u0000"',
        "'é\u202e'",
        '"' + "a" * 5000 + '"',
        "1979-05-27",
        "0001-01-01T00:00:00Z",
        "07:32:00",
    ),
    *(
        "[" * 1200,
        DEEP,
        "{a=" * 900 + "1" + "}" * 900,
        "[nan]",
        "[[1, 2], [3]]",
        '["a"]',
        "s**2",
        "x_s(0)",
    ),
    *(
        "(" * 70 + "x" + ")" * 70,
        "1/0",
        "1e308*1e308",
        "9**9**9**9",
        "s**1000",
        "-" * 500 + "1",
        "a.b",
        "=",
    ),
)
"""What a value in a text file is replaced with."""
_VALUE = re.compile(r"\"[^\"\n]*\"|[-+]?\d[\w.+-]*|\b(?:true|false)\b|\[[^\[\]\n]*\]")


def fewer(by: int, **more: Any) -> settings:
    """The profile's settings with so many times fewer examples, for what takes milliseconds."""
    profile = settings.default
    assert profile is not None
    return settings(max_examples=max(8, profile.max_examples // by), **more)


@st.composite
def bytes_of(draw: st.DrawFn, raw: bytes) -> bytes:
    """Bytes with one to four things wrong: bits, lengths, pieces lost, repeated, swapped or made up."""
    data = bytearray(raw)
    for _ in range(draw(st.integers(1, 4))):
        size = len(data)
        at = draw(st.integers(0, max(0, size - 1)))
        span = draw(st.integers(1, 64))
        match draw(st.integers(0, 7)):
            case 0 if size:
                data[at] ^= 1 << draw(st.integers(0, 7))
            case 1 if size:
                data[at] = draw(st.integers(0, 255))
            case 2:
                del data[at:]
            case 3:
                del data[at : at + span]
            case 4:
                data[at:at] = data[at : at + span]
            case 5:
                other = draw(st.integers(0, max(0, size - 1)))
                piece = bytes(data[other : other + span])
                data[at : at + len(piece)] = piece
            case 6:
                width = draw(st.sampled_from((2, 4, 8)))
                number = draw(st.sampled_from(_SIZES)) % 256**width
                data[at : at + width] = number.to_bytes(
                    width, draw(st.sampled_from(("little", "big")))
                )
            case _:
                data[at:at] = draw(st.binary(max_size=16))
    return bytes(data)


@st.composite
def text_of(draw: st.DrawFn, text: str) -> bytes:
    """A text file with one to three things wrong: lines lost, repeated, swapped, cut; values replaced."""
    for _ in range(draw(st.integers(1, 3))):
        lines = text.splitlines(keepends=True) or [""]
        at = draw(st.integers(0, len(lines) - 1))
        other = draw(st.integers(0, len(lines) - 1))
        match draw(st.integers(0, 6)):
            case 0:
                del lines[at]
            case 1:
                lines.insert(other, lines[at])
            case 2:
                lines[at], lines[other] = lines[other], lines[at]
            case 3:
                lines[at] = lines[at][: draw(st.integers(0, len(lines[at])))]
            case _:
                values = list(_VALUE.finditer(text))
                if values:
                    one = values[draw(st.integers(0, len(values) - 1))]
                    new = draw(st.sampled_from(TOKENS))
                    lines = [text[: one.start()], new, text[one.end() :]]
        text = "".join(lines)
    raw = text.encode(errors="surrogatepass")
    return draw(bytes_of(raw)) if draw(st.integers(0, 9)) == 9 else raw


@st.composite
def json_of(draw: st.DrawFn, text: str) -> str:
    """JSON with one to three of its values or keys replaced, lost, repeated or added: perhaps no JSON then."""
    value = json.loads(text)
    for _ in range(draw(st.integers(1, 3))):
        value = _damage(draw, value)
    out = json.dumps(value)  # NaN and Infinity as Python writes them
    return out.replace(f'"{_DEEP_MARK}"', DEEP)


def _damage(draw: st.DrawFn, value: Any) -> Any:
    """Go down by chance, then change what is there."""
    if isinstance(value, dict | list) and value and draw(st.integers(0, 7)):
        keys = list(value) if isinstance(value, dict) else range(len(value))
        key: Any = keys[draw(st.integers(0, len(keys) - 1))]
        match draw(st.integers(0, 9)):
            case 0:
                value = value.copy()
                del value[key]
            case 1 if isinstance(value, list):
                value = [*value, value[key]]
            case 1:
                assert isinstance(value, dict)
                value = {**value, draw(st.sampled_from(("", "x", "base64", "é"))): value[key]}
            case 2 if isinstance(value, list):
                other = draw(st.integers(0, len(value) - 1))
                value = value.copy()
                value[key], value[other] = value[other], value[key]
            case _:
                value = value.copy()
                value[key] = _damage(draw, value[key])
        return value
    if isinstance(value, int | float) and draw(st.integers(0, 3)):
        return draw(st.sampled_from(NUMBERS))
    if isinstance(value, str) and value and draw(st.booleans()):
        cut = draw(st.integers(0, len(value) - 1))
        return value[:cut] + draw(st.sampled_from(("", "A", "=", "\u2028"))) + value[cut + 1 :]
    return draw(st.sampled_from((*NUMBERS, *ODD)))


def damaged(text: str) -> st.SearchStrategy[bytes]:
    """A JSON text as a file's bytes: damaged as JSON or as bytes, or nothing like it."""
    as_json = json_of(text).map(lambda one: one.encode(errors="surrogatepass"))
    return as_json | bytes_of(text.encode()) | st.binary(max_size=80)


def outcome(call: Callable[[], T], *refusals: type[Exception]) -> tuple[T | None, str]:
    """What a call gives and no text, or nothing and the text of its refusal; any other exception fails."""
    try:
        return call(), ""
    except refusals as error:
        return None, str(error)
