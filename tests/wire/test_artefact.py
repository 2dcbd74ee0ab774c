"""The gains artefact: exact round trips, and only the two documented errors for anything else."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from wire.artefact import (
    FORMAT,
    OLDEST_VERSION,
    VERSION,
    Arm,
    Certificate,
    GainsArtefact,
    OperatorFactors,
    PolynomialMatrix,
    Setpoint,
    check,
    digest,
    parse_artefact,
    read_artefact,
    write_artefact,
)
from wire.errors import GainsRefusedError, UsageError

ARM = Arm("arm with a name: ä", 0.7, 0.02, 4.1e3, 1.03e3, 0.017)


def certificate(outcome: str = "certified") -> Certificate:
    return Certificate(
        outcome,
        0.14,
        0.1,
        1.2,
        0.08,
        0.01,
        12.0,
        0.3,
        -1e-3,
        1e-9,
        [12, 24],
        232,
        14,
        "S",
        "ok",
        1.5,
    )


def factors(seed: int, outputs: int, inputs: int, rank1: int, rank2: int) -> OperatorFactors:
    random = np.random.default_rng(seed)
    shapes = [(outputs, inputs), (outputs, rank1), (rank1, inputs), (outputs, rank2)]
    return OperatorFactors(
        *(
            PolynomialMatrix.from_array(random.standard_normal((*shape, degree + 1)))
            for degree, shape in enumerate([*shapes, (rank2, inputs)])
        )
    )


def artefact(ranks: tuple[int, int] = (2, 3)) -> GainsArtefact:
    setpoints = [
        Setpoint(
            name=name,
            curvature_per_m=[0.1, 1.0 / 3.0, -2e-300],
            strain=[1e-17],
            feedforward_n_per_m=[0.1 + 0.2, math.pi],
            tip_m=[0.7, -0.0],
            observer=factors(seed, 4, 2, *ranks),
            controller=factors(seed + 1, 1, 4, *ranks),
            observer_certificate=certificate(),
            controller_certificate=certificate(),
        )
        for seed, name in enumerate(("straight", "ä"))
    ]
    return GainsArtefact(ARM, {"measurement_noise": 0.1}, setpoints, {"numpy": "0"})


def whole_file(content: bytes, **head: Any) -> bytes:
    """A gains file around any content, with a fitting digest unless `head` says otherwise."""
    fields = {"format": FORMAT, "version": VERSION, "sha256": hashlib.sha256(content).hexdigest()}
    text = json.dumps(fields | head)
    return text[:-1].encode() + b', "content": ' + content + b"}"


def edited(change: Callable[[dict[str, Any]], object]) -> bytes:
    """A file whose content was changed and sealed again."""
    content = msgspec.to_builtins(artefact())
    change(content)
    return whole_file(json.dumps(content).encode())


def refusal(raw: bytes) -> str:
    with pytest.raises(GainsRefusedError) as error:
        parse_artefact(raw, "the file")
    assert str(error.value).startswith("the file")
    return str(error.value)


# Round trips


@pytest.mark.parametrize("ranks", [(2, 3), (0, 2), (2, 0), (0, 0)])
def test_round_trip_is_exact(tmp_path: Path, ranks: tuple[int, int]) -> None:
    path = tmp_path / "new" / "arm.gains.json"
    wanted = artefact(ranks)
    sha = write_artefact(wanted, path)
    got = read_artefact(path)
    assert got == wanted
    assert sha == digest(wanted) == digest(got)
    assert json.loads(path.read_bytes())["sha256"] == sha
    for one, other in zip(got.setpoints, wanted.setpoints, strict=True):
        for key in ("n0", "n1a", "n1b", "n2a", "n2b"):
            for role in ("observer", "controller"):
                left = getattr(getattr(one, role), key).array
                np.testing.assert_array_equal(left, getattr(getattr(other, role), key).array)
    assert math.copysign(1.0, got.setpoints[0].tip_m[1]) == -1.0
    assert list(path.parent.iterdir()) == [path]  # no temporary file stays


def test_bytes_are_enough(tmp_path: Path) -> None:
    path = tmp_path / "arm.gains.json"
    write_artefact(artefact(), path)
    assert parse_artefact(path.read_bytes(), "an attachment") == artefact()


def test_digest_is_that_of_the_content_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "arm.gains.json"
    sha = write_artefact(artefact(), path)
    content = path.read_bytes().split(b'"content":', 1)[1].removesuffix(b"}\n")
    assert hashlib.sha256(content).hexdigest() == sha


def test_digest_depends_on_the_content_alone() -> None:
    one = artefact()
    same = msgspec.structs.replace(one, versions=dict(one.versions))
    assert digest(same) == digest(one)
    other_order = msgspec.structs.replace(one, versions={"b": "1", "a": "2"})
    assert digest(other_order) == digest(
        msgspec.structs.replace(one, versions={"a": "2", "b": "1"})
    )
    changed = msgspec.structs.replace(
        one, arm=msgspec.structs.replace(ARM, radius_m=math.nextafter(ARM.radius_m, 1.0))
    )
    assert digest(changed) != digest(one)


def test_second_write_replaces_the_first(tmp_path: Path) -> None:
    path = tmp_path / "arm.gains.json"
    write_artefact(artefact(), path)
    second = artefact((1, 1))
    write_artefact(second, path)
    assert read_artefact(path) == second


def test_failed_write_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a directory"
    path.mkdir()
    with pytest.raises(OSError, match="directory"):
        write_artefact(artefact(), path)
    assert list(tmp_path.iterdir()) == [path]
    assert list(path.iterdir()) == []


def test_polynomials_are_legendre_series_in_the_arc() -> None:
    matrix = PolynomialMatrix([[[1.0, 2.0, 3.0]]])
    length, s = 0.7, np.array([0.0, 0.2, 0.7])
    x = 2.0 * s / length - 1.0
    expected = 1.0 + 2.0 * x + 3.0 * 0.5 * (3.0 * x**2 - 1.0)
    got = matrix(s, length)
    assert got.shape == (3, 1, 1)
    np.testing.assert_allclose(got[:, 0, 0], expected, rtol=1e-14)
    assert PolynomialMatrix([])(s, length).shape == (3, 0, 0)
    assert PolynomialMatrix([[], []])(s, length).shape == (3, 2, 0)


def test_arm_quantities() -> None:
    arm = Arm("chapter", 1.0, 0.025, 5e3, 1.1e3, 0.0)
    assert arm.mass_per_length_kg_per_m == pytest.approx(2.16, abs=5e-3)  # theory, section 1
    assert arm.axial_stiffness_n == pytest.approx(9.82, abs=5e-3)
    assert arm.bending_stiffness_n_m2 == pytest.approx(1.534e-3, abs=5e-7)


def test_setpoint_names() -> None:
    assert artefact().setpoint_index("ä") == 1
    with pytest.raises(UsageError, match=r"'2'.*straight, ä"):
        artefact().setpoint_index("2")


# Refusals


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"none\.json.*octarm design.*--gains"):
        read_artefact(tmp_path / "none.json")
    with pytest.raises(UsageError, match="directory"):
        read_artefact(tmp_path)


def test_message_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "empty.json"
    path.write_bytes(b"")
    with pytest.raises(GainsRefusedError, match=r"empty\.json.*octarm design"):
        read_artefact(path)


def test_truncated_anywhere(tmp_path: Path) -> None:
    path = tmp_path / "arm.gains.json"
    write_artefact(artefact(), path)
    raw = path.read_bytes()
    parse_artefact(raw[:-1], "without the last line end")
    for end in [*range(200), *range(200, len(raw) - 2, 61), len(raw) - 2]:
        assert "not a whole octarm gains file" in refusal(raw[:end])


def test_every_flipped_byte_of_the_content_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "arm.gains.json"
    write_artefact(artefact(), path)
    raw = path.read_bytes()
    start = raw.index(b'"content":') + len(b'"content":')
    for place in [*range(start, start + 50), *range(start + 50, len(raw) - 2, 37)]:
        for mask in (0x01, 0x80):
            broken = bytearray(raw)
            broken[place] ^= mask
            with pytest.raises(GainsRefusedError):
                parse_artefact(bytes(broken), "flipped")


def test_edited_number_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "arm.gains.json"
    write_artefact(artefact(), path)
    message = refusal(path.read_bytes().replace(b'"length_m":0.7', b'"length_m":0.8'))
    assert "SHA-256" in message
    assert "damaged or edited" in message


def test_edited_digest_is_noticed() -> None:
    content = msgspec.json.encode(artefact())
    assert "SHA-256" in refusal(whole_file(content, sha256="0" * 64))


def test_other_format_and_version() -> None:
    content = msgspec.json.encode(artefact())
    assert "expected format 'octarm-gains', got 'octarm-run'" in refusal(
        whole_file(content, format="octarm-run")
    )
    future = refusal(whole_file(b'{"of": "tomorrow"}', version=VERSION + 1))
    assert (
        f"format version {VERSION + 1}, this octarm reads {OLDEST_VERSION} to {VERSION}" in future
    )
    assert "not a whole octarm gains file" in refusal(whole_file(content, version="1"))
    assert "unknown field `more`" in refusal(whole_file(content, more=1))


def test_version_1_is_read_with_the_options_defaults() -> None:
    """A file of the first version, as it was written then: no options in its arm."""
    content = msgspec.to_builtins(artefact())
    for option in ("kelvin_voigt_s", "actuator", "measured"):
        del content["arm"][option]
    old = parse_artefact(whole_file(json.dumps(content).encode(), version=1), "the file")
    assert old == artefact()
    assert (old.arm.kelvin_voigt_s, old.arm.actuator) == (0.0, "transverse")
    assert old.arm.measured == ["v_y", "k"]


def test_options_survive_the_file(tmp_path: Path) -> None:
    arm = msgspec.structs.replace(ARM, kelvin_voigt_s=0.4, actuator="normal", measured=["k"])
    wanted = msgspec.structs.replace(artefact(), arm=arm)
    write_artefact(wanted, tmp_path / "a")
    assert read_artefact(tmp_path / "a") == wanted


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("kelvin_voigt_s", -1e-9),
        ("kelvin_voigt_s", math.inf),
        ("actuator", "tangential"),
        ("measured", []),
        ("measured", ["k", "v_y"]),
        ("measured", ["v_y"]),
    ],
)
def test_options_that_there_are_not_are_refused(option: str, value: Any) -> None:
    with pytest.raises(ValueError, match=option):
        msgspec.structs.replace(ARM, **{option: value})
    if value != math.inf:
        message = refusal(edited(lambda c: c["arm"].update({option: value})))
        assert option in message


BROKEN: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "extra key": (lambda c: c.update(colour="red"), "colour"),
    "extra key inside": (lambda c: c["setpoints"][1].update(colour="red"), "setpoints[1]"),
    "missing key": (lambda c: c["arm"].pop("drag_per_s"), "drag_per_s"),
    "negative length": (lambda c: c["arm"].update(length_m=-1.0), "length_m"),
    "no number": (lambda c: c["arm"].update(radius_m="thin"), "radius_m"),
    "null for a number": (lambda c: c["setpoints"][0].update(tip_m=[None, 1.0]), "tip_m"),
    "no setpoints": (lambda c: c["setpoints"].clear(), "no setpoint"),
    "one name twice": (lambda c: c["setpoints"][1].update(name="straight"), "every name once"),
    "three coordinates": (lambda c: c["setpoints"][0]["tip_m"].append(0.0), "tip_m"),
    "no curvature": (lambda c: c["setpoints"][0]["curvature_per_m"].clear(), "curvature_per_m"),
    "no strain": (lambda c: c["setpoints"][0]["strain"].clear(), "strain"),
    "uncertified": (
        lambda c: c["setpoints"][1]["controller_certificate"].update(outcome="unreliable"),
        "setpoints[1] (ä).controller: its certificate says 'unreliable'",
    ),
    "row missing": (
        lambda c: c["setpoints"][0]["observer"]["n0"]["coefficients"].pop(),
        "setpoints[0] (straight).observer.n0: expected 4 x 2 polynomials, got shape (3, 2, 1)",
    ),
    "no rows at all": (
        lambda c: c["setpoints"][0]["observer"]["n0"]["coefficients"].clear(),
        "observer.n0",
    ),
    "ranks differ": (
        lambda c: c["setpoints"][0]["controller"]["n1b"]["coefficients"].clear(),
        "setpoints[0] (straight).controller.n1a: expected 1 x 0 polynomials, got shape (1, 2, 2)",
    ),
    "columns missing": (
        lambda c: [row.clear() for row in c["setpoints"][0]["controller"]["n2b"]["coefficients"]],
        "controller.n2b",
    ),
    "no coefficients": (
        lambda c: [
            entry.clear()
            for row in c["setpoints"][0]["observer"]["n0"]["coefficients"]
            for entry in row
        ],
        "observer.n0",
    ),
    "ragged": (
        lambda c: c["setpoints"][1]["observer"]["n2a"]["coefficients"][0][1].append(0.0),
        "setpoints[1] (ä).observer.n2a: ragged",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_sealed_but_wrong(case: str) -> None:
    change, culprit = BROKEN[case]
    assert culprit in refusal(edited(change))


@pytest.mark.parametrize("number", ["1e400", "-1e400", "NaN", "Infinity"])
def test_number_that_is_not_finite(number: str) -> None:
    content = msgspec.json.encode(artefact()).replace(
        b'"length_m":0.7', b'"length_m":' + number.encode()
    )
    refusal(whole_file(content))
    content = msgspec.json.encode(artefact()).replace(b"[1e-17]", b"[" + number.encode() + b"]")
    refusal(whole_file(content))


def replaced(part: str, **fields: Any) -> GainsArtefact:
    """The artefact with fields of the second setpoint, or of a part of it, exchanged."""
    whole = artefact()
    old = whole.setpoints[1]
    new = (
        msgspec.structs.replace(old, **fields)
        if part == "setpoint"
        else msgspec.structs.replace(
            old, **{part: msgspec.structs.replace(getattr(old, part), **fields)}
        )
    )
    return msgspec.structs.replace(whole, setpoints=[whole.setpoints[0], new])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    ("part", "field"),
    [
        ("setpoint", "strain"),
        ("setpoint", "tip_m"),
        ("observer", "n0"),
        ("controller", "n2b"),
        ("observer_certificate", "optimum_gamma"),
        ("controller_certificate", "certified_gamma"),
    ],
)
def test_nothing_is_written_that_could_not_be_read(
    tmp_path: Path, part: str, field: str, value: float
) -> None:
    """JSON has no such numbers: they would become null and the file unreadable."""
    if part == "setpoint":
        broken = replaced(part, **{field: [value, 1.0]})
    elif field.startswith("n"):
        array = getattr(getattr(artefact().setpoints[1], part), field).array
        array[-1, -1, -1] = value
        broken = replaced(part, **{field: PolynomialMatrix.from_array(array)})
    else:
        broken = replaced(part, **{field: value})
    with pytest.raises(GainsRefusedError, match=rf"setpoints\[1\] \(ä\).*{field}.*not finite"):
        write_artefact(broken, tmp_path / "arm.gains.json")
    assert list(tmp_path.iterdir()) == []


def test_weights_are_finite() -> None:
    with pytest.raises(GainsRefusedError, match=r"weights\['effort'\]"):
        check(msgspec.structs.replace(artefact(), weights={"effort": math.inf}), "here")


def test_uncertified_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(GainsRefusedError, match="infeasible"):
        write_artefact(
            replaced("setpoint", observer_certificate=certificate("infeasible")),
            tmp_path / "arm.gains.json",
        )
    assert list(tmp_path.iterdir()) == []


# Anything at all


@given(st.binary(max_size=200))
def test_arbitrary_bytes(raw: bytes) -> None:
    with pytest.raises(GainsRefusedError):
        parse_artefact(raw, "noise")


@pytest.mark.parametrize("raw", [b"[" * 100_000, b'{"content":' * 100_000, b"\xff\xfe", b"null"])
def test_hostile_bytes(raw: bytes) -> None:
    refusal(raw)
    refusal(whole_file(raw))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4)
    ),
    max_leaves=10,
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """All paths into a JSON value."""
    items = list(value.items() if isinstance(value, dict) else enumerate(value))
    out = []
    for key, inner in items:
        out.append((*path, key))
        if isinstance(inner, dict | list):
            out += places(inner, (*path, key))
    return out


@settings(max_examples=200, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data(), value=JSON)
def test_sealed_content_with_one_value_exchanged(data: st.DataObject, value: Any) -> None:
    content = msgspec.to_builtins(artefact())
    *way, last = data.draw(st.sampled_from(places(content)))
    target = content
    for key in way:
        target = target[key]
    target[last] = value
    try:
        read = parse_artefact(whole_file(json.dumps(content).encode()), "mutated")
    except GainsRefusedError:
        return
    check(read, "what was accepted")
    assert parse_artefact(whole_file(msgspec.json.encode(read)), "again") == read


@settings(max_examples=200)
@given(data=st.data())
def test_damaged_bytes(data: st.DataObject) -> None:
    raw = bytearray(whole_file(msgspec.json.encode(artefact())))
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(raw) - 1))
        raw[place : place + data.draw(st.integers(0, 30))] = data.draw(st.binary(max_size=4))
    try:
        assert parse_artefact(bytes(raw), "damaged") == artefact()
    except GainsRefusedError:
        return
