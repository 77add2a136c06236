"""A map, a run or a library may come from anyone: what is no file of its own is refused, by every verb, by its path."""

from __future__ import annotations

import ast
import json
import os
import shutil
import socket
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import vplog
from tests.maps.runs import LIBRARY, make_map
from vplog.errors import LogError, ResultError
from vplog.maps.storage import map_store
from vplog.maps.storage.layout import folder_name
from vplog.results import run_record
from vplog.storage.folders import check_regular, regular_files
from vplog.storage.input_hashes import hash_inputs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from conftest import Said

    from vplog.verbs.demo.record import Demo

    Verb = Callable[..., Said]

WALK = f"runs/{folder_name('walk')}"
PLACES = {
    "drive folder": f"{WALK}/result.mcap", "record": f"{WALK}/drive.json", "run": f"runs/{folder_name('other')}",
    "table": f"keyframes/{folder_name('walk')}/keyframes.parquet", "library": f"libraries/{LIBRARY}/more",
    "libraries": "libraries/other", "joins": f"joins/{folder_name('walk')}/joins.json", "joint": "joint/component=1",
    "index": "index/a.segment", "staging": ".staging/1-0", "cache": f".cache/{folder_name('walk')}",
    "deep": f"{WALK}/a/b/c/.d", "failures": "failures.json", "lock": ".lock",
}  # fmt: skip
"""What is put in the place of a file of a map, or beside its files."""
MAP_VERBS: dict[str, list[str]] = {
    "info": ["map", "info", "MAP"], "export": ["map", "export", "MAP", "-o", "OUT"], "index": ["map", "index", "MAP"],
    "query": ["map", "query", "MAP", "LOG"], "join": ["map", "join", "MAP"], "remove": ["map", "remove", "MAP", "walk"],
    "merge": ["map", "merge", "MAP", "-o", "OUT"], "merge into": ["map", "merge", "SOUND", "-o", "MAP"],
    "batch": ["batch", "LOG", "-o", "MAP"], "redescribe": ["map", "redescribe", "MAP", "--library", "LOG", "-o", "OUT"],
}  # fmt: skip
RUN_VERBS: dict[str, list[str]] = {
    "evaluate": ["evaluate", "RUN", "--truth", "gps"], "report": ["report", "RUN"],
    "explain": ["explain", "RUN", "--worst"], "export": ["export", "RUN", "--format", "tum", "-o", "OUT"],
    "map export": ["map", "export", "RUN", "-o", "OUT"], "resume": ["run", "--resume", "-o", "RUN"],
    "run": ["run", "LOG", "-o", "RUN"],
}  # fmt: skip
LIBRARY_VERBS: dict[str, list[str]] = {
    "run": ["run", "LOG", "--library", "LIB", "-o", "OUT"], "batch": ["batch", "LOG", "--library", "LIB", "-o", "OUT"],
    "redescribe": ["map", "redescribe", "SOUND", "--library", "LIB", "-o", "OUT"],
    "library": ["library", "LOG", "-o", "LIB"],
}  # fmt: skip


def put_bad(path: Path, kind: str, outside: Path) -> None:
    """A link, pipe, socket or device in the place of a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(path, ignore_errors=True)
    path.unlink(missing_ok=True)
    match kind:
        case "link to a file":
            path.symlink_to(outside / "secret")
        case "link to a folder":
            path.symlink_to(outside)
        case "dangling link":
            path.symlink_to(outside / "none")
        case "link within":
            path.symlink_to("map.json")
        case "pipe":
            os.mkfifo(path)
        case "socket":
            here = Path.cwd()
            os.chdir(path.parent)  # a socket's path has at most 108 bytes
            with socket.socket(socket.AF_UNIX) as one:
                one.bind(path.name)
            os.chdir(here)
        case _:
            try:
                os.mknod(path, 0o20600, os.makedev(1, 3))
            except PermissionError:  # only root makes devices, and not on every machine
                os.mkfifo(path)


KINDS = ["link to a file", "link to a folder", "dangling link", "link within", "pipe", "socket", "device"]


def each_kind(places: Iterable[str], verb: int) -> Iterator[tuple[str, str]]:
    """Places with a kind each, so that every kind is at every place with one of seven verbs in a row and, where there
    are seven places, with every verb."""
    for number, place in enumerate(places, verb):
        yield place, KINDS[number % len(KINDS)]


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    folder = tmp_path / "outside"
    folder.mkdir()
    (folder / "secret").write_text("{}")
    return folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tests leave it as it is."""
    root = make_map(tmp_path_factory.mktemp("whole") / "map", {"walk": 1, "ride": 2})
    (root / "failures.json").write_text(json.dumps({"bad": {"log": "/logs/bad.mcap", "error": "It broke."}}))
    return root


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tests leave it as it is."""
    return make_map(tmp_path_factory.mktemp("sound") / "map", {"swim": 3})


@pytest.fixture
def root(whole: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole, tmp_path / "map")


def refused(said: Said, bad: Path, outside: Path) -> None:
    """One line that names the path; nothing outside is touched."""
    assert str(bad) in said.error
    assert {path.name: path.read_text() for path in outside.iterdir()} == {"secret": "{}"}


@pytest.mark.parametrize("name", MAP_VERBS)
def test_a_map_with_what_is_not_its_own_is_refused(
    whole: Path, sound: Path, outside: Path, drive: Demo, verb: Verb, tmp_path: Path, name: str
) -> None:
    for number, (place, kind) in enumerate(each_kind(PLACES.values(), list(MAP_VERBS).index(name))):
        here = tmp_path / f"map-{number}"
        shutil.copytree(whole, here)
        put_bad(here / place, kind, outside)
        known = {"MAP": here, "LOG": drive.log, "OUT": tmp_path / f"out-{number}", "SOUND": sound}
        before = sorted(path for path in here.rglob("*") if not path.is_symlink())
        refused(verb(*(known.get(word, word) for word in MAP_VERBS[name])), here / place, outside)
        assert sorted(path for path in here.rglob("*") if not path.is_symlink()) == before
        assert not known["OUT"].exists() or not list((known["OUT"]).glob("runs/*"))


@pytest.mark.parametrize("name", MAP_VERBS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_map_whose_head_is_no_file_is_no_map(
    root: Path, sound: Path, outside: Path, drive: Demo, verb: Verb, tmp_path: Path, name: str, kind: str
) -> None:
    put_bad(root / "map.json", kind, outside)
    known = {"MAP": root, "LOG": drive.log, "OUT": tmp_path / "out", "SOUND": sound}
    refused(verb(*(known.get(word, word) for word in MAP_VERBS[name])), root, outside)


@pytest.mark.parametrize("name", RUN_VERBS)
def test_a_run_with_what_is_not_its_own_is_refused(
    whole: Path, outside: Path, drive: Demo, verb: Verb, tmp_path: Path, name: str
) -> None:
    places = [
        "result.mcap",
        "run.json",
        "report.html",
        ".cache/a.part",
        "library/references.parquet",
        "sunday/run.json",
        "closure-1.png",
        "a/b/c/.d",
    ]
    for number, (place, kind) in enumerate(each_kind(places, list(RUN_VERBS).index(name))):
        here = tmp_path / f"run-{number}"
        shutil.copytree(whole / WALK, here)
        put_bad(here / place, kind, outside)
        known = {"RUN": here, "LOG": drive.log, "OUT": tmp_path / f"out-{number}"}
        refused(verb(*(known.get(word, word) for word in RUN_VERBS[name])), here / place, outside)


@pytest.mark.parametrize("name", LIBRARY_VERBS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_library_with_what_is_not_its_own_is_refused(
    root: Path, outside: Path, drive: Demo, verb: Verb, tmp_path: Path, name: str, kind: str
) -> None:
    (root / "map.json").write_text(json.dumps({**run_record.read_run_json(root / "map.json"), "settings": {}}))
    place = ("references.parquet", "features.parquet", "more/deep")[(KINDS.index(kind) + len(name)) % 3]
    here = tmp_path / "library"
    shutil.copytree(root / "libraries" / LIBRARY, here)
    put_bad(here / place, kind, outside)
    known = {"LIB": here, "LOG": drive.log, "OUT": tmp_path / "out", "SOUND": root}
    refused(verb(*(known.get(word, word) for word in LIBRARY_VERBS[name])), here / place, outside)


def test_a_name_that_no_record_can_hold_is_refused(root: Path, verb: Verb, tmp_path: Path) -> None:
    """As disks of other systems have them: a path of bytes that are not UTF-8."""
    (root / WALK / "\udcff").touch()
    assert "is not UTF-8, which records are. Rename it." in verb("map", "merge", root, "-o", tmp_path / "new").error
    with pytest.raises(LogError, match="is not UTF-8"):
        hash_inputs(root)  # of a folder of images


def test_a_folder_that_is_given_may_be_a_link(root: Path, verb: Verb, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(root)
    assert verb("map", "info", tmp_path / "link", "--json").json["places"]
    with map_store.writing(tmp_path / "link") as store:
        assert store.drives()
    (tmp_path / "run").symlink_to(root / WALK)
    check_regular(tmp_path / "run", "run.json")


def test_what_is_no_map_is_not_searched(outside: Path, verb: Verb) -> None:
    """A home folder that is named by mistake has thousands of links."""
    (outside / "link").symlink_to("/")
    assert "has no map.json" in verb("map", "info", outside).error
    assert "Is" in verb("evaluate", outside, "--truth", "gps").error
    assert "holds other things" in verb("map", "merge", make_map(outside.parent / "map", {"a": 1}), "-o", outside).error


def test_files_are_listed_in_order_and_what_goes_away_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("b/c/d", "a", ".e", "b/.f"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    assert list(regular_files(tmp_path)) == [".e", "a", "b/.f", "b/c/d"]
    assert list(regular_files(tmp_path / "none")) == []
    found = regular_files(tmp_path)
    assert next(found) == ".e"
    shutil.rmtree(tmp_path / "b")
    assert list(found) == ["a"]

    def refuse(_: Path) -> Any:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "scandir", refuse)
    with pytest.raises(ResultError, match=r"Permission denied\. Check its permissions"):
        check_regular(tmp_path)


ALLOWED = {
    "storage/folders.py": "disk_bytes, the size of a map: it does not follow links, as du",
    "storage/input_hashes.py": "logs are the user's own",
    "logs/masks.py": "masks are the user's own",
    "storage/remote_path.py": "own scratch folders, and objects of a store",
    "storage/user_cache.py": "the user's own cache", "run/run_folder.py": "names of cache files alone",
}  # fmt: skip


def follows_links(call: ast.Call) -> bool:
    """Whether a call goes down folders and follows links on the way."""
    name = ast.unparse(call.func)
    kept = any(one.arg == "symlinks" and ast.unparse(one.value) == "True" for one in call.keywords)
    return name == "os.walk" or (name.endswith((".rglob", ".copytree")) and not kept)


def test_no_reader_goes_down_folders_otherwise() -> None:
    package = Path(vplog.__file__).parent
    texts = {file: file.read_text(encoding="utf-8") for file in package.rglob("*.py")}
    found = {
        file.relative_to(package).as_posix()
        for file, text in texts.items()
        if any(name in text for name in ("os.walk", "rglob", "copytree"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call) and follows_links(node)
    }
    assert found <= ALLOWED.keys()
