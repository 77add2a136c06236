"""A map may come from anyone: what is damaged in it is one line, and nothing is waited for."""

from __future__ import annotations

import json
import os
import shutil
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.benchmarks.scale import made_up_library, write_drive
from tests.benchmarks.search import make_places
from tests.maps.runs import make_map
from vplog.maps.search.index import update_index
from vplog.maps.storage.map_store import Store, folder_name
from vplog.places.bobb import BobbSettings
from vplog.results import run_record

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from conftest import Said

    Verb = Callable[..., Said]

BAD: tuple[Any, ...] = (
    None, [], {}, "x", -1, True, 10**400, float("nan"), float("inf"), "\ud800", [[]], {"a": {"b": [None]}},
)  # fmt: skip
"""Values of the wrong kind; numbers that none reckons with; half a character."""
GPS = {
    "origin": {"latitude_deg": 48.0, "longitude_deg": 11.0, "altitude_m": 500.0},
    "world_from_enu": np.eye(4).tolist(),
}
RUN = {
    "finished": True, "settings": {"seed": 0}, "gps": GPS, "warnings": [],
    "counts": {"keyframes": 3, "verdicts": {"accepted": 1}}, "totals": {"seconds": 1.5, "peak_memory_mb": 80.0},
}  # fmt: skip
FAILURES = {"bad": {"log": "/logs/bad.mcap", "error": "It broke.", "attempts": 1}}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = make_map(tmp_path_factory.mktemp("damage") / "map", {"walk": 1, "ride": 2})
    (root / "failures.json").write_text(json.dumps(FAILURES))
    run = root / "runs" / folder_name("walk")
    (run / "run.json").write_text(json.dumps(RUN))
    return root


def damaged(tree: Any) -> Iterator[Any]:
    """The tree with each of its values replaced, and without each."""
    for key in tree:
        for bad in BAD:
            yield {**tree, key: bad}
        yield {name: value for name, value in tree.items() if name != key}
        if isinstance(tree[key], dict):
            for inner in damaged(tree[key]):
                yield {**tree, key: inner}


def check(said: Said) -> None:
    assert said.code in (0, 1)
    assert "Traceback" not in said.err
    assert "Internal error" not in said.err
    if said.code:
        assert len([line for line in said.err.splitlines() if not line.startswith("warning:")]) == 1


@pytest.mark.parametrize("name", ["runs/drive=walk/run.json", "runs/drive=walk/drive.json", "failures.json"])
def test_records_that_say_something_else_are_one_line(root: Path, verb: Verb, tmp_path: Path, name: str) -> None:
    here = tmp_path / "map"
    shutil.copytree(root, here)
    tree, about = run_record.read_run_json(here / name), here / "runs" / "drive=walk" / "drive.json"
    run_record.write_run_json(about, {**run_record.read_run_json(about), "files": {}})  # without hashes
    if name.endswith("drive.json"):
        tree.pop("earth", None)  # which run.json says then
    every = [*damaged(tree), *damaged({**tree, "earth": {"bounds": [1, 2, 3, 4]}})][::10]  # of 13 of each
    for number, bad in enumerate([*every, {"topics": json.loads("[" * 300 + "]" * 300)}]):
        (here / name).write_text(json.dumps(bad))
        check(verb("map", "info", here, *["--json"][: number % 2]))
        check(verb("map", "export", here, "-o", tmp_path / "places.parquet", "--format", "geoparquet"))
        if number % 4 == 0:
            check(verb("map", "merge", here, "-o", tmp_path / f"to-{number}"))


@pytest.mark.parametrize("kind", ["pipe", "folder", "loop"])
def test_what_is_no_file_is_no_part_of_an_index(tmp_path: Path, kind: str) -> None:
    settings = BobbSettings(references=4, windows_along=2)
    state, store = made_up_library(settings, 30), Store(tmp_path)
    write_drive(store, 0, make_places(40, settings, 0, 30, 40), state)

    def update() -> tuple[list[Any], list[str]]:
        return update_index(store, store.drives(), state)

    [part], _ = update()
    assert part.path is not None
    for path in (part.path, part.path.with_name("other.lists")):
        path.unlink(missing_ok=True)
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()
        else:
            path.symlink_to(path)
    parts, warnings = update()
    assert sum(part.places for part in parts) == 40, "which are indexed in memory"
    assert any(part.path.name in warning for warning in warnings)


@pytest.mark.parametrize("text", ["", "[", "[]", '{"a": 1}', '{"a": {"error": 1}}'])
def test_a_damaged_record_of_failures_stops_no_verb(root: Path, verb: Verb, tmp_path: Path, text: str) -> None:
    here = shutil.copytree(root, tmp_path / "map")
    (here / "failures.json").write_text(text)
    [problem] = [one for one in verb("map", "info", here, "--json").json["problems"] if "failures" in one]
    assert problem.endswith("failures.json is damaged, so it is not known what failed. The next batch writes it again.")
    assert verb("map", "remove", here, "ride").code == 0
