"""A damaged drive of a map is named and left out of every answer; the others are not, and a batch computes it again."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.benchmarks.scale import made_up_library, write_drive
from tests.benchmarks.search import make_places
from tests.maps.runs import LIBRARY, PLACES, make_map
from vplog.errors import ResultError
from vplog.maps.joining.joint_record import read_joint, write_joint
from vplog.maps.search.index import update_index
from vplog.maps.storage import map_store
from vplog.maps.storage.contents import damage_warnings, skip_damaged
from vplog.maps.storage.damage import damaged_files
from vplog.maps.storage.layout import drive_record, set_drive_id
from vplog.maps.storage.map_store import Store, folder_name
from vplog.places.bobb import BobbSettings
from vplog.results import run_record

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    Verb = Callable[..., Said]

DRIVES = {"walk": 1, "ride": 2, "sail": 3}
TABLES = [f"{name}.parquet" for name in map_store.TABLES]


def flip(path: Path, seed: int = 0) -> None:
    """Another bit in place of one; the name stays that of a file of its own."""
    data = bytearray(path.read_bytes())
    bit = int(np.random.default_rng(seed).integers(8 * len(data)))
    data[bit // 8] ^= 1 << bit % 8
    path.unlink()
    path.write_bytes(data)


def cut(path: Path) -> None:
    data = path.read_bytes()
    path.unlink()
    path.write_bytes(data[: len(data) // 2])


def empty(path: Path) -> None:
    path.unlink()
    path.touch()


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "flip": flip, "cut": cut, "gone": lambda path: path.unlink(), "empty": empty,
}  # fmt: skip


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_map(tmp_path_factory.mktemp("quarantine") / "map", DRIVES)


def copied(root: Path, here: Path) -> Path:
    shutil.copytree(root, here, copy_function=shutil.copyfile)
    return here


@pytest.mark.parametrize("how", DAMAGES)
@pytest.mark.parametrize("name", [*TABLES, "run.json"])
def test_the_others_are_answered_with(root: Path, verb: Verb, tmp_path: Path, name: str, how: str) -> None:
    """What needs the damaged file leaves its drive out, and says which; what does not, has it."""
    here = copied(root, tmp_path / "map")
    DAMAGES[how](here / "runs" / folder_name("walk") / name)
    said = verb("map", "export", here, "-o", tmp_path / "places.parquet", "--json")
    assert said.code == 0, said.err
    assert set(said.json["drives"]) >= DRIVES.keys() - {"walk"}
    if said.json["drives"] != sorted(DRIVES):
        assert said.json["places"] == 2 * PLACES
        assert "walk is damaged and left out" in said.json["warnings"][0]
    elif how == "flip":
        assert said.json["places"] == 3 * PLACES
    said = verb("map", "info", here, "--json")
    assert said.code == 0, said.err
    assert {one["drive"] for one in said.json["drives"]} >= DRIVES.keys() - {"walk"}
    if how != "flip":
        assert [one["drive"] for one in said.json["drives"]] == ["ride", "sail"]
        assert name in said.json["damaged"]["walk"]
        assert sum("walk is damaged" in problem for problem in said.json["problems"]) == 1
    said = verb("map", "merge", here, "-o", tmp_path / "merged", "--json")
    assert said.code == 0, said.err
    assert [one["drive"] for one in said.json["drives"]] == ["ride", "sail"]
    assert "walk is damaged and left out" in said.json["warnings"][0]
    said = verb("map", "remove", here, "walk", "--json")
    assert said.code == 0, said.err
    assert said.json["drives"] == ["ride", "sail"]


def test_a_damaged_record_leaves_its_drive_out(root: Path, verb: Verb, tmp_path: Path) -> None:
    here = copied(root, tmp_path / "map")
    path = here / "runs" / folder_name("walk") / "drive.json"
    for bad in ("{", "[]", "{}", json.dumps({**run_record.read_run_json(path), "inputs": 7})):
        path.write_text(bad)
        said = verb("map", "info", here, "--json")
        assert [one["drive"] for one in said.json["drives"]] == ["ride", "sail"]
        assert list(said.json["damaged"]) == ["walk"]
    path.unlink()
    said = verb("map", "export", here, "-o", tmp_path / "places.parquet", "--json")
    assert said.json["drives"] == ["ride", "sail"]
    assert "walk is damaged and left out" in said.json["warnings"][0]


def test_a_map_can_be_written_to_with_a_damaged_drive_in_it(root: Path, tmp_path: Path) -> None:
    """And the drive is back when it was computed again."""
    here = copied(root, tmp_path / "map")
    (here / "runs" / folder_name("walk") / "edges.parquet").unlink()
    again = make_map(tmp_path / "again", {"walk": 1})
    with map_store.writing(here) as store:
        assert list(store.drives()) == ["ride", "sail"]
        made = store.staging / "made"
        shutil.copytree(again / "runs" / folder_name("walk"), made)
        map_store.publish(store, "walk", made)
        assert list(store.drives()) == sorted(DRIVES)
        assert damage_warnings(store) == []
    with map_store.reading(here) as store:
        assert list(store.drives()) == sorted(DRIVES)


def test_every_flip_in_a_run_folder_is_found_by_the_check(root: Path, verb: Verb, tmp_path: Path) -> None:
    here = copied(root, tmp_path / "map")
    run = here / "runs" / folder_name("walk")
    assert damaged_files(run) == []
    said = verb("map", "info", here, "--check")
    assert said.code == 0
    assert "damaged" not in said.err
    names = sorted(path.name for path in run.iterdir() if path.name != "drive.json")
    for number, name in enumerate(names):
        whole = (run / name).read_bytes()
        for seed in range(20):
            flip(run / name, 100 * number + seed)
            [line] = damaged_files(run)
            assert str(run / name) in line
            (run / name).write_bytes(whole)
    for name in names[:2]:
        flip(run / name)
    (run / names[2]).unlink()
    said = verb("map", "info", here, "--check", "--json")
    assert said.code == 1
    lines = json.loads(said.out)["damaged_files"]
    assert len(lines) == 3
    assert all(any(name in line for line in lines) for name in names[:3])
    said = verb("map", "info", here, "--check")
    assert said.code == 1
    assert all(sum(name in line for line in said.err.splitlines()) >= 1 for name in names[:3])
    assert "Traceback" not in said.err


@pytest.mark.parametrize("name", ["map.json", "drive.json", "run.json", "joint.json", "failures.json"])
def test_no_flip_in_a_record_is_silent(root: Path, tmp_path: Path, name: str) -> None:
    """A drive whose record is damaged is left out, what failed is not known; a damaged map.json or joint.json is one
    line."""
    here = copied(root, tmp_path / "map")
    Store(here).update_failures({"bad": {"log": "/logs/bad.mcap", "error": "It broke."}})
    write_joint(here, {"groups": [], "alone": sorted(DRIVES), "apart": {}, "keys": {}})
    [path] = here.glob(f"runs/drive=walk/{name}") if name in ("drive.json", "run.json") else here.glob(name)

    def read() -> tuple[Any, ...]:
        with map_store.reading(here) as store:
            drives = {drive: store.read(drive, record_of) for drive in store.drives()}
            failed = store.failures_or_damage()[1].partition(",")[0] or store.failures()
            return store.head(), read_joint(here).get("alone"), failed, drives

    def record_of(folder: Path) -> Any:
        record = drive_record(folder)
        named = {name: record.get(name) for name in ("drive", "log", "key", "library", "inputs", "earth", "files")}
        return named, run_record.read_run_json(folder / "run.json")

    whole, wanted = path.read_bytes(), read()
    without_walk = (*wanted[:3], {drive: about for drive, about in wanted[3].items() if drive != "walk"})
    without_failures = (*wanted[:2], f"{here}/failures.json is damaged", wanted[3])
    for seed in range(200):
        flip(path, seed)
        try:
            found = read()
            assert found in (wanted, without_walk, without_failures)
        except ResultError as error:
            assert str(path) in str(error)
            assert "\n" not in str(error)
        path.write_bytes(whole)


def test_an_index_is_made_of_the_sound_drives(tmp_path: Path) -> None:
    settings = BobbSettings(references=4, windows_along=2)
    state, store = made_up_library(settings, 30), Store(tmp_path)
    for first in range(3):
        write_drive(store, first, make_places(40, settings, first, 30, 40), state)
    drives = list(store.drives())
    flip(store.file(drives[1], "descriptors.parquet"))

    def update() -> list[Any]:
        return update_index(store, store.drives(), state)[0]

    parts = skip_damaged(store, update)
    assert list(store.damaged) == [drives[1]]
    assert sum(part.places for part in parts) == 80
    assert [one.drive for part in parts for one in part.segment.contents] == [drives[0], drives[2]]


def test_a_newer_map_is_refused_in_one_line(root: Path, verb: Verb, tmp_path: Path) -> None:
    """No drive of it is taken for damaged."""
    for name in ("map.json", f"runs/{folder_name('walk')}/drive.json"):
        here = copied(root, tmp_path / name.replace("/", "-"))
        record = run_record.read_run_json(here / name)
        (here / name).write_text(json.dumps({**record, "format": 2, "vplog": "9.8"}))
        for arguments in (
            ("info", here),
            ("export", here, "-o", tmp_path / "x"),
            ("merge", here, "-o", tmp_path / "y"),
        ):
            said = verb("map", *arguments)
            assert "version 2 of its format, and this vplog reads up to version 1. Update vplog" in said.error


def test_what_another_program_calls_a_map_is_none(root: Path, verb: Verb, tmp_path: Path) -> None:
    (tmp_path / "map.json").write_text('{"mine": 1}')
    assert "map.json names no version of its format, so vplog did not write it" in verb("map", "info", tmp_path).error
    assert "vplog did not write it" in verb("map", "merge", root, "-o", tmp_path).error
    assert (tmp_path / "map.json").read_text() == '{"mine": 1}'


def test_the_check_reads_what_joins_drives_too(root: Path, verb: Verb, tmp_path: Path) -> None:
    here = copied(root, tmp_path / "map")
    path = here / "joins" / folder_name("walk") / "match=ride.parquet"
    path.parent.mkdir(parents=True)
    shutil.copyfile(here / "runs" / folder_name("walk") / "closures.parquet", path)
    assert verb("map", "info", here, "--check").code == 0
    flip(path)
    said = verb("map", "info", here, "--check")
    assert said.code == 1
    assert str(path) in said.err


def test_a_damaged_head_is_written_again_from_the_drives(tmp_path: Path) -> None:
    """Where these have one library and the same settings; else nobody guesses."""
    store = Store(make_map(tmp_path / "map", {"walk": 1, "ride": 1}))
    path = store.root / "map.json"
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(ResultError, match=r"map\.json"):
        store.head()
    head = store.recovered_head()
    assert (head.library, head.settings) == (LIBRARY, {"seed": 1})
    store.write_head(head)
    assert store.head() == head
    other = Store(make_map(tmp_path / "other", {"walk": 1, "ride": 2}))
    (other.root / "map.json").write_text("{")
    with pytest.raises(ResultError, match=r"map\.json"):
        other.recovered_head()
    path.unlink()
    with pytest.raises(ResultError, match="is not a map"):
        store.recovered_head()


@pytest.mark.parametrize("settings", [None, "", "[]", "[" * 10**6])
def test_a_table_without_its_settings_is_said_in_one_line(settings: str | None, tmp_path: Path) -> None:
    path = make_map(tmp_path / "map", DRIVES) / "runs" / folder_name("walk") / "keyframes.parquet"
    table = pq.read_table(path)
    header = {key: value for key, value in table.schema.metadata.items() if key != b"vplog.settings"}
    path.unlink()
    pq.write_table(table.replace_schema_metadata(header | ({"vplog.settings": settings} if settings else {})), path)
    with pytest.raises(ResultError, match=r"keyframes\.parquet lacks its settings"):
        set_drive_id(path, "stroll")
