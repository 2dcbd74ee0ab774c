"""The text of one expression: its syntax tree, and errors that point into it; used by `expression`.

The text is read by Python's `ast` and never executed. Whatever the grammar of problem files does not know is
refused here or by the evaluator over the tree.
"""

from __future__ import annotations

import ast
import keyword
import re
import warnings

from wire.errors import UsageError

MAX_LENGTH = 4000
"""Characters of an expression."""
_FOREIGN = re.compile(r"[^A-Za-z0-9_.,+\-*/() ]")
_WORD = re.compile(r"[A-Za-z_]\w*")
_HINTS = {
    "^": "; a power is written with **, as in s**2",
    "=": "; only a boundary condition may be written with =",
}


def shortened(text: str, limit: int = 60) -> str:
    """At most `limit` characters of a text, for messages."""
    return text if len(text) <= limit else text[: limit - 4] + " ..."


class Source:
    """The text of an expression and where it stands: `where` (file and key) opens every message.

    sides: the syntax tree, or the two trees of "left = right" where `equation` allows it, with columns
    counted in the whole text. UsageError if the text cannot be read.
    """

    def __init__(self, text: str, where: str, equation: bool = False) -> None:
        self.text, self.where = re.sub(r"\s", " ", text), where
        if len(text) > MAX_LENGTH:
            raise UsageError(
                f"{where}: the expression has {len(text)} characters, but at most {MAX_LENGTH} are read; "
                "shorten it with parameters or further states"
            )
        pieces = self.text.split("=") if equation else [self.text]
        if len(pieces) > 2:
            raise self.error(
                self.text.rindex("="), 1, "occurs twice: a condition is 'left = right'"
            )
        self.sides: list[ast.expr] = []
        start = 0
        for piece in pieces:
            self.sides.append(self._parse(piece, start))
            start += len(piece) + 1

    def _parse(self, piece: str, start: int) -> ast.expr:
        stripped = piece.strip()
        start += len(piece) - len(piece.lstrip())
        if not stripped:
            raise UsageError(
                f"{self.where}: expected an expression, got an empty one: {self.text!r}"
            )
        foreign = _FOREIGN.search(stripped)
        if foreign:
            hint = _HINTS.get(foreign[0], "")
            raise self.error(start + foreign.start(), 1, f"has no meaning in an expression{hint}")
        for word in _WORD.finditer(stripped):
            if keyword.iskeyword(word[0]):
                message = "is reserved and cannot be a name; choose another"
                raise self.error(start + word.start(), len(word[0]), message)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                tree = ast.parse(stripped, mode="eval").body
        except SyntaxError as error:
            if "nested" in error.msg:
                raise self._too_deep(stripped) from None
            at = min(start + max(0, (error.offset or 1) - 1), start + len(stripped))
            raise self.error(
                at,
                1,
                "cannot be read here: products are written with *, powers with **, and every ( needs its )",
            ) from None
        except (ValueError, RecursionError, MemoryError):
            raise self._too_deep(stripped) from None
        for node in ast.walk(tree):
            if isinstance(node, ast.expr):
                node.col_offset += start
                node.end_col_offset = start + (node.end_col_offset or 0)
        return tree

    def _too_deep(self, text: str) -> UsageError:
        return UsageError(
            f"{self.where}: {shortened(text)!r} is nested too deeply; expand it, or use further states"
        )

    def of(self, node: ast.expr) -> str:
        """The text of a part of the tree."""
        return self.text[node.col_offset : node.end_col_offset]

    def refuse(self, node: ast.expr, message: str) -> UsageError:
        """The error "file: key: 'term' message", with a line that points at the term."""
        return self.error(node.col_offset, len(self.of(node)), message)

    def error(self, at: int, length: int, message: str) -> UsageError:
        """As `refuse`, for `length` characters from `at`."""
        term = shortened(self.text[at : at + length])
        head = f"{self.where}: {repr(term) if term.strip() else 'the expression'} {message}"
        if len(self.text) > 100:
            return UsageError(f"{head} (character {at + 1} of {len(self.text)})")
        return UsageError(f"{head}\n    {self.text}\n    {' ' * at}{'^' * max(1, length)}")
