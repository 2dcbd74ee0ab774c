"""What `octarm chapter` does: asks each part for its prose, figures and numbers, and makes a page of it.

Between the command line and the parts (chapter.model, …), which are imported when their turn comes. A directory
that has pages of other parts already keeps them: the index and facts.json are of all that is there.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib as mpl

from analysis.one_thread import one_thread
from analysis.text_table import aligned
from analysis.whole_directory import make_directory
from analysis.whole_file import whole
from chapter import markdown
from chapter.part import Part, Tell
from wire.errors import UsageError

PARTS = ("model", "setpoints", "operators", "ode", "lpi", "inverse", "decentral", "observer")
"""In the order of the chapter."""
FACTS, INDEX = "facts.json", "README.md"
_STYLE = {"font.size": 10.0, "axes.titlesize": 10.5, "axes.titlelocation": "left"}
DPI = 100


@dataclass(frozen=True)
class Reproduction:
    """What was made."""

    facts: dict[str, Any]
    """As --json prints them, of the parts that were asked for."""
    table: str
    files: tuple[Path, ...]


def choose(names: Sequence[str]) -> tuple[str, ...]:
    """The parts that were named, all if none was, in the chapter's order; UsageError for any other name."""
    unknown = [name for name in names if name not in PARTS]
    if unknown:
        raise UsageError(
            f"part {', '.join(unknown)}: there is no such part of the chapter; there are {', '.join(PARTS)}"
        )
    return tuple(part for part in PARTS if not names or part in names)


def reproduce(names: Sequence[str], out: Path, tell: Tell) -> Reproduction:
    """Make the pages of the parts named (all if none is) in the directory `out`.

    A page, its figures and its entry in facts.json appear when the part is done; what was there of it is
    written over, what is there of other parts stays. The same bytes on one machine, however many processors
    there are: linear algebra keeps to one thread. Raises UsageError for an unknown part or a directory that
    cannot be written or holds a facts.json that is not this command's.
    """
    chosen = choose(names)
    make_directory(out)
    _there(out)
    made: dict[str, Any] = {}
    files: list[Path] = []
    for number, name in enumerate(chosen, start=1):
        with one_thread(), mpl.rc_context(_STYLE):
            tell(f"{name} ({number} of {len(chosen)})")
            part: Part = importlib.import_module(f"chapter.{name}").part(tell)
            pictures = {file: _png(figure) for file, figure in part.figures.items()}
        made[name] = _facts(part)
        for file, picture in pictures.items():
            files.append(_write(out / file, picture))
        files.append(_write(out / f"{name}.md", page(part).encode()))
        there = _there(out) | made  # somebody else may have made other parts meanwhile
        ordered = {key: there[key] for key in PARTS if key in there}
        _write(out / FACTS, (json.dumps(ordered, indent=1, allow_nan=False) + "\n").encode())
        _write(out / INDEX, index(ordered).encode())
    files += [out / FACTS, out / INDEX]
    return Reproduction(
        {"parts": made, "files": [str(f) for f in files]}, table(made), tuple(files)
    )


def page(part: Part) -> str:
    """The page of a part, Markdown."""
    lines = [
        f"# {part.title}",
        "",
        f"Section {part.section} of the chapter. Made by `octarm chapter {part.key}`.",
        "",
    ]
    if part.claims:
        lines += [*claim_table([asdict(claim) for claim in part.claims]), ""]
    return "\n".join(lines) + "\n" + part.text.strip() + "\n"


def claim_table(claims: Sequence[Mapping[str, Any]]) -> list[str]:
    """Claims of the chapter and what became of them, lines of Markdown."""
    rows = [
        (c["where"], c["printed"], "holds" if c["holds"] else "**corrected**", c["found"])
        for c in claims
    ]
    return markdown.table(("where", "printed", "", "found"), rows).splitlines()


def index(facts: Mapping[str, Mapping[str, Any]]) -> str:
    """The page that names all others, with every correction, Markdown."""
    lines = [
        "# The source chapter, reproduced",
        "",
        "Every equation, figure and claim of the chapter that octarm implements: as printed, and as it has to "
        "be. Made by `octarm chapter`; the numbers are in [facts.json](facts.json), and the tests hold them to "
        "what they say.",
        "",
        markdown.table(
            ("section", "page", "claims that hold", "corrected"),
            [
                (one["section"], f"[{one['title']}]({key}.md)", *_counts(one))
                for key, one in facts.items()
            ],
        ),
    ]
    wrong = [claim for one in facts.values() for claim in one["claims"] if not claim["holds"]]
    if wrong:
        lines += ["", "## All corrections", "", *claim_table(wrong)]
    return "\n".join(lines) + "\n"


def table(facts: Mapping[str, Mapping[str, Any]]) -> str:
    """What was made, for a terminal."""
    head = ("part", "section", "holds", "corrected", "figures", "title")
    rows = []
    for key, one in facts.items():
        figures = str(len(one["figures"]))
        rows.append((key, one["section"], *_counts(one), figures, one["title"]))
    return "\n".join(aligned(head, rows, left=range(len(head)))) + "\n"


def _counts(facts: Mapping[str, Any]) -> tuple[str, str]:
    """Claims of a part that hold, and that do not."""
    good = sum(claim["holds"] for claim in facts["claims"])
    return str(good), str(len(facts["claims"]) - good)


def _facts(part: Part) -> dict[str, Any]:
    return {
        "title": part.title,
        "section": part.section,
        "claims": [asdict(claim) for claim in part.claims],
        "figures": list(part.figures),
        "numbers": dict(part.facts),
    }


def _png(figure: Any) -> bytes:
    """The same bytes for the same figure and version of Matplotlib."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return buffer.getvalue()


def _there(out: Path) -> dict[str, Any]:
    """The facts of the parts that the directory has."""
    try:
        text = (out / FACTS).read_text()
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError):
        text = ""
    with suppress(ValueError, RecursionError):
        facts = json.loads(text)
        keys = {"title", "section", "claims", "figures", "numbers"}
        if isinstance(facts, dict) and all(
            isinstance(one, dict) and keys <= one.keys() for one in facts.values()
        ):
            return facts
    raise UsageError(
        f"--out {out}: its {FACTS} was not made by `octarm chapter`; give another directory or remove it"
    )


def _write(path: Path, content: bytes) -> Path:
    """Write a file that takes its place when it is whole."""
    with whole(path, force=True) as growing:
        growing.write_bytes(content)
    return path
