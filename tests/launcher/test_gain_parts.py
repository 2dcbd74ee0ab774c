"""Parts of a design: taken exactly when they answer what is asked, and never when damaged."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from stand_in_gains import arm_text, finished

import design
from design.arm_file import ArmFile, read_arm_file
from design.command import Job, jobs
from design.gain import Options
from supervise import gain_parts
from supervise.gain_parts import GainParts, code_digest
from wire.errors import UsageError

OBSERVER, CONTROLLER = Job(0, "1", "observer"), Job(0, "1", "controller")


def arm_file(folder: Path, text: str | None = None) -> ArmFile:
    path = folder / "arm.toml"
    path.write_text(arm_text("1", "2") if text is None else text)
    return read_arm_file(path)


@pytest.fixture
def parts(tmp_path: Path) -> GainParts:
    made = GainParts(tmp_path / "my.gains.json", arm_file(tmp_path), Options())
    made.directory.mkdir()
    return made


def test_what_is_taken_is_what_was_kept(parts: GainParts) -> None:
    for job in jobs(parts._file):
        assert parts.take(job) is None
        parts.keep(job, finished(job.index, job.role))
    for job in jobs(parts._file):
        assert parts.take(job) == finished(job.index, job.role)
    assert parts.directory.name == "my.gains.json.parts"
    assert len(list(parts.directory.iterdir())) == 4
    assert parts.others(jobs(parts._file)) == 0


def keys(file: ArmFile, options: Options | None = None) -> list[str]:
    store = GainParts(Path("out.json"), file, options or Options())
    return [store.path(job).name for job in (OBSERVER, CONTROLLER)]


def edited(**sections: dict[str, Any]) -> Callable[[ArmFile], ArmFile]:
    def edit(file: ArmFile) -> ArmFile:
        new = {
            name: msgspec.structs.replace(getattr(file, name), **values)
            for name, values in sections.items()
        }
        return msgspec.structs.replace(file, **new)

    return edit


def other_shape(file: ArmFile) -> ArmFile:
    first = msgspec.structs.replace(file.setpoints[0], curvature_per_m=[1.1, -2.2, 1.1])
    return msgspec.structs.replace(file, setpoints=[first, file.setpoints[1]])


def other_names(file: ArmFile) -> ArmFile:
    first = msgspec.structs.replace(file.setpoints[0], name="another")
    return msgspec.structs.replace(file, name="mine", setpoints=[first])


CHANGES: dict[str, tuple[Callable[[ArmFile], ArmFile], bool, bool]] = {
    "length": (edited(geometry={"length_m": 1.1}), True, True),
    "material": (edited(material={"youngs_modulus_pa": 5.1e3}), True, True),
    "drag": (edited(damping={"drag_per_s": 0.021}), True, True),
    "Kelvin-Voigt": (edited(damping={"kelvin_voigt_s": 0.1}), True, True),
    "actuator": (edited(actuators={"force": "normal"}), True, True),
    "sensors": (edited(sensors={"measured": ["k"]}), True, True),
    "noise weight": (edited(weights={"measurement_noise": 0.21}), True, False),
    "effort weight": (edited(weights={"control_effort": 0.31}), False, True),
    "shape": (other_shape, True, True),
    "names": (other_names, False, False),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_part_belongs_to_the_data_that_its_gain_depends_on(change: str, tmp_path: Path) -> None:
    edit, observer, controller = CHANGES[change]
    file = arm_file(tmp_path)
    before, after = keys(file), keys(edit(file))
    assert [b != a for b, a in zip(before, after, strict=True)] == [observer, controller]


@pytest.mark.parametrize(
    "options", [{"solver": "SCS"}, {"time_limit_s": 200.0}, {"counts": (2,)}], ids=str
)
def test_a_part_belongs_to_its_options(options: dict[str, Any], tmp_path: Path) -> None:
    file = arm_file(tmp_path)
    assert not set(keys(file)) & set(keys(file, Options(**options)))


def test_a_part_belongs_to_its_versions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = arm_file(tmp_path)
    before = keys(file)
    monkeypatch.setattr(gain_parts, "versions", lambda: {"clarabel": "another"})
    assert not set(before) & set(keys(file))


def test_a_part_belongs_to_the_programs_that_made_it(tmp_path: Path) -> None:
    root = Path(design.__path__[0]).parent
    for room in ("design", "deploy", "wire"):
        shutil.copytree(root / room, tmp_path / room)
    before = code_digest(tmp_path)
    programs = (
        "design/gain.py",
        "design/hinf.py",
        "design/legendre.py",
        "deploy/model.py",
        "wire/artefact.py",
    )
    others = ("design/command.py", "deploy/deployment.py", "wire/messages.py")
    for name in (*programs, *others):
        file = tmp_path / name
        file.write_text(file.read_text() + "\n")
        assert (code_digest.__wrapped__(tmp_path) != before) == (name in programs), name
        file.write_text(file.read_text()[:-1])
    assert code_digest.__wrapped__(tmp_path) == before


# Parts that are no use


def truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def altered(path: Path) -> None:
    text = path.read_text()
    assert "0.1414" in text
    path.write_text(text.replace("0.1414", "0.1314"))


def empty(path: Path) -> None:
    path.write_bytes(b"")


def binary(path: Path) -> None:
    path.write_bytes(bytes(range(256)))


def other_json(path: Path) -> None:
    path.write_text('{"key": "mine"}')


def nested(path: Path) -> None:
    path.write_text("[" * 100_000)


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


DAMAGE = (truncated, altered, empty, binary, other_json, nested, folder)


@pytest.mark.parametrize("damage", DAMAGE, ids=lambda f: f.__name__)
def test_a_damaged_part_is_no_part(damage: Callable[[Path], None], parts: GainParts) -> None:
    parts.keep(OBSERVER, finished(0, "observer"))
    damage(parts.path(OBSERVER))
    with pytest.raises(ValueError, match=r"\w"):
        parts.take(OBSERVER)
    if damage is not folder:
        parts.keep(OBSERVER, finished(0, "observer"))
        assert parts.take(OBSERVER) == finished(0, "observer")


def test_a_part_under_another_name_is_no_part(parts: GainParts) -> None:
    other = Job(1, "2", "observer")
    parts.keep(OBSERVER, finished(0, "observer"))
    parts.path(OBSERVER).rename(parts.path(other))
    with pytest.raises(ValueError, match="made for something else"):
        parts.take(other)


def test_a_gain_that_could_not_run_is_no_part(parts: GainParts) -> None:
    gain = finished(0, "observer")
    refused = msgspec.structs.replace(gain.certificate, outcome="infeasible")
    parts.keep(OBSERVER, msgspec.structs.replace(gain, certificate=refused))
    with pytest.raises(ValueError, match="'infeasible'"):
        parts.take(OBSERVER)
    parts.keep(CONTROLLER, gain)  # of an observer's shape
    with pytest.raises(ValueError, match="expected 1 x 4"):
        parts.take(CONTROLLER)


# The directory


def test_only_what_is_its_own_is_removed(parts: GainParts, tmp_path: Path) -> None:
    parts.keep(OBSERVER, finished(0, "observer"))
    changed = edited(weights={"measurement_noise": 0.5})(parts._file)
    later = GainParts(tmp_path / "my.gains.json", changed, Options())
    assert later.take(OBSERVER) is None
    assert later.others([OBSERVER, CONTROLLER]) == 1
    for name in ("mine.json", "notes.txt"):
        (parts.directory / name).write_text("mine")
    with later.locked():
        later.remove()
    assert sorted(path.name for path in parts.directory.iterdir()) == ["mine.json", "notes.txt"]


def test_nothing_is_left_of_a_directory_that_was_not_needed(tmp_path: Path) -> None:
    file = arm_file(tmp_path)
    with GainParts(tmp_path / "a" / "b" / "out.json", file, Options()).locked():
        assert (tmp_path / "a" / "b" / "out.json.parts").is_dir()
    assert [path.name for path in tmp_path.iterdir()] == ["arm.toml"]


def test_one_design_at_a_time(parts: GainParts) -> None:
    again = GainParts(parts.directory.with_suffix(""), parts._file, Options())
    assert again.directory == parts.directory
    with parts.locked():
        parts.keep(OBSERVER, finished(0, "observer"))
        with (
            pytest.raises(UsageError, match=r"my\.gains\.json\.parts: another `octarm design`"),
            again.locked(),
        ):
            pass
        assert parts.take(OBSERVER) is not None
    with again.locked():
        assert again.take(OBSERVER) is not None


def test_a_directory_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "out.json.parts").write_text("mine")
    parts = GainParts(tmp_path / "out.json", arm_file(tmp_path), Options())
    with pytest.raises(UsageError, match=r"--out: .*out\.json\.parts"), parts.locked():
        pass
    assert (tmp_path / "out.json.parts").read_text() == "mine"


def test_every_option_is_in_the_key() -> None:
    """`vars` of the options: a new option would be in it; nothing to forget."""
    assert set(vars(Options())) == {field.name for field in dataclasses.fields(Options)}
