"""`--spacing`: names, lists and files of segment boundaries, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from closed_form import write_gains

from supervise.options import RunOptions
from supervise.plan import prepare
from supervise.spacing import parse_spacing, spacing_name
from wire.errors import UsageError


@pytest.mark.parametrize("name", ["equispaced", "chebyshev"])
def test_names_stay_names(name: str) -> None:
    assert parse_spacing(name, 7) == name
    assert spacing_name(parse_spacing(name, 7)) == name


def test_a_list_is_typed_or_read_from_a_file(tmp_path: Path) -> None:
    expected = (0.0, 0.25, 0.5, 1.0)
    assert parse_spacing("0,.25, 5e-1,1", 3) == expected
    file = tmp_path / "graded.txt"
    file.write_text("# m, root to tip\n0, 0.25\n0.5   1 # tip\n\n")
    assert parse_spacing(str(file), 3) == expected
    file.write_text("0, 0.25\r\n0.5, 1\r\n", encoding="utf-8-sig")  # as some editors save it
    assert parse_spacing(str(file), 3) == expected
    assert spacing_name(expected) == "given"


def test_the_run_is_deployed_on_the_boundaries(tmp_path: Path) -> None:
    gains = write_gains(tmp_path / "test.gains.json")
    options = RunOptions(gains=gains, nodes=4, spacing="0,0.1,0.3,0.6,1")
    deployment = prepare(options).deployment
    assert deployment.faces_m.tolist() == [0.0, 0.1, 0.3, 0.6, 1.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("random", "expected equispaced, chebyshev, a comma-separated list .* No such file"),
        ("0,0.5,1", "10 nodes need 11 segment boundaries .* got 3; for these, --nodes 2"),
        ("1,", "got 1$"),
        ("0,a quarter,1", "expected numbers in m, got 'a'"),
        (".", "as a file: Is a directory"),
        ("x\0y", "as a file"),
    ],
)
def test_refusals_say_what_is_wrong(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        RunOptions(spacing=text)


def test_a_wrong_line_of_a_file_is_named(tmp_path: Path) -> None:
    file = tmp_path / "graded.txt"
    file.write_bytes(b"0\n0.5 m\n1\n")
    with pytest.raises(UsageError, match=r"graded.txt, line 2: expected numbers in m, got 'm'"):
        parse_spacing(str(file), 2)
    file.write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(UsageError, match="line 1: expected numbers"):
        parse_spacing(str(file), 2)
    file.write_bytes(b"0 " * (1 << 20))
    with pytest.raises(UsageError, match="at most 1048576 bytes"):
        parse_spacing(str(file), 2)


def test_boundaries_that_do_not_divide_the_arm_are_refused(tmp_path: Path) -> None:
    gains = write_gains(tmp_path / "test.gains.json")
    with pytest.raises(UsageError, match=r"face 1 is at 0\.7 m, face 2 at 0.5 m"):
        prepare(RunOptions(gains=gains, nodes=3, spacing="0,0.7,0.5,1"))
    with pytest.raises(UsageError, match="end at the arm's length 1 m, got 0 to 2 m"):
        prepare(RunOptions(gains=gains, nodes=2, spacing="0,0.5,2"))
    with pytest.raises(UsageError, match="face 1 is nan"):
        prepare(RunOptions(gains=gains, nodes=2, spacing="0,nan,1"))
