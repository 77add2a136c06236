"""What was read of a map on an object store is not fetched again, and never believed."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import pytest

from tests.maps.bucket import serving
from tests.maps.runs import put_rows
from vplog.errors import ResultError
from vplog.execution.execution import Execution
from vplog.maps.search.query import MapQuery, open_map, search
from vplog.maps.search.sequences import LineSearch
from vplog.maps.storage import map_store, objects
from vplog.maps.storage.download_cache import Cache, cache_in
from vplog.maps.storage.layout import sha256_of
from vplog.maps.storage.remote_map import StoredFile
from vplog.pipeline import load_pipeline
from vplog.places.sequence import SequenceSettings
from vplog.results import tables
from vplog.storage.remote_path import RemotePath, located

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from conftest import Said

    from vplog.places.bobb import BobbState

    Verb = Callable[..., Said]


@pytest.fixture(scope="module")
def server() -> Iterator[None]:
    with serving():
        yield


@pytest.fixture(scope="module")
def library(finished: Path) -> str:
    return json.loads((finished / "library" / "library.json").read_text())["hash"]


def fill(root: Path, finished: Path, library: str) -> Path:
    """A map of every place of the run, and of its first ten."""
    with map_store.writing(root) as store:
        shutil.copytree(finished / "library", store.staging / "library")
        map_store.add_library(store, store.staging / "library", library)
        store.write_head(map_store.Head(library, load_pipeline("default").model_dump(mode="json")))
        put_rows(store, "all", finished, library)
        put_rows(store, "ten", finished, library, slice(10))
    return root


@pytest.fixture
def root(server: None, finished: Path, library: str, request: pytest.FixtureRequest) -> Any:
    return fill(located(f"s3://bucket/{request.node.name}"), finished, library)


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the objects that were fetched as files, in the order in which they came."""
    names: list[str] = []
    fetch = objects.fetch

    def fetching(path: Any, target: Path, most: int) -> str:
        names.append(str(path).rpartition("/")[2])
        return fetch(path, target, most)

    monkeypatch.setattr(objects, "fetch", fetching)
    return names


def asked(root: Path, finished: Path, cache: Cache | None = None, length: int = 1) -> dict[str, list[Any]]:
    """The two best places of the map for some views of the run, as a query has them."""
    with map_store.reading(root, cache) as store:
        drives, _, state = open_map(store, Execution())
        column = tables.read_descriptors(finished / "descriptors.parquet")[0]
        views = state.from_arrow(column.cast(cast("BobbState", state).arrow_type))[::5]
        answers, told = search(store, drives, state, views, MapQuery(2), LineSearch(SequenceSettings(length=length)))
    assert not told
    return {name: values.tolist() for name, values in vars(answers).items()}


def files(cache: Cache) -> set[Path]:
    return {path for path in cache.root.rglob("*") if path.is_file()}


@pytest.fixture
def cache(tmp_path: Path) -> Cache:
    found = cache_in(tmp_path / "cache", 1.0)
    assert found is not None
    return found


def test_a_second_query_asks_for_manifests_alone(
    root: Any, finished: Path, library: str, verb: Verb, fetched: list[str], cache: Cache, tmp_path: Path
) -> None:
    here = fill(tmp_path / "map", finished, library)
    expected = asked(here, finished), asked(here, finished, length=5)
    assert asked(root, finished, cache) == expected[0]
    once = sorted(fetched)
    assert once == ["descriptors.parquet"] * 2 + ["features.parquet", "library.json", "references.parquet"]
    kept = {path: (path.stat().st_ino, path.read_bytes()) for path in files(cache)}
    [index] = [path for path in kept if path.suffix == ".lists"]
    assert asked(root, finished, cache) == expected[0]
    assert asked(root, finished, cache, length=5) == expected[1]
    told = verb("map", "index", root, "--cache", cache.root.parent, "--json").json
    assert told["segments"] == [str(index)]
    assert sorted(fetched) == once
    assert {path: (path.stat().st_ino, path.read_bytes()) for path in files(cache)} == kept

    for one in (root, here):  # a drive more, and one that is another under the same name
        with map_store.writing(one) as store:
            put_rows(store, "back", finished, library, slice(None, None, -1))
            put_rows(store, "ten", finished, library, slice(10, 30))
    fetched.clear()
    assert asked(root, finished, cache) == asked(here, finished) != expected[0]
    assert fetched == ["descriptors.parquet"] * 2
    assert not list(cache.open_folders.iterdir())


def test_what_is_damaged_is_fetched_or_made_again(root: Any, finished: Path, cache: Cache) -> None:
    expected = asked(root, finished, cache)
    kept = {path: path.read_bytes() for path in files(cache)}
    assert len(kept) == 5 + 1, "objects and an index"

    def turned(whole: bytes) -> bytes:
        middle = len(whole) // 2
        return whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :]

    for broken in (turned, lambda whole: whole[:-1], lambda _: b""):
        for path, whole in kept.items():
            path.unlink()
            path.write_bytes(broken(whole))
        assert asked(root, finished, cache) == expected
        assert {path: path.read_bytes() for path in files(cache)} == kept
    for path, whole in kept.items():  # of all that a query reads each by itself
        path.unlink()
        path.write_bytes(turned(whole))
        assert asked(root, finished, cache) == expected


def test_the_oldest_goes_first(tmp_path: Path) -> None:
    cache = Cache(tmp_path / "cache", 2500)
    names = []
    for number in range(4):
        file = tmp_path / f"{number}"
        file.write_bytes(bytes([number]) * 1000)
        names.append(sha256_of(file))
        cache.keep(names[-1], file)
        os.utime(cache.root / "objects" / names[-1], (number, number))
    assert cache.fetch_to(names[0], tmp_path / "again"), "which makes it young"
    cache.trim()
    assert {path.name for path in (cache.root / "objects").iterdir()} == {names[0], names[3]}
    assert (tmp_path / "again").read_bytes() == bytes(1000)
    assert not cache.fetch_to(names[1], tmp_path / "gone")
    left, own = cache.root / "objects" / f".{names[1]}.1-1.part", cache.root / "objects" / "deep" / "own.part"
    own.parent.mkdir()
    for path in (left, own):
        path.touch()
    cache.trim()
    assert left.exists()
    for path in (left, own):
        os.utime(path, (0, 0))
    cache.trim()
    assert not left.exists()
    assert own.exists(), "no file of the cache"


def test_what_workers_fetch_is_within_the_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And what one leaves that is killed goes a day later, as all half-written files."""
    cache, old = Cache(tmp_path, 2500), time.time() - 10**5
    parts = list[Path]()

    def fetch(place: RemotePath, target: Path, _: int) -> str:
        parts.append(target)
        target.write_bytes(place.name.encode() * 1000)
        if place.name == "x":
            raise OSError("reset")
        return hashlib.sha256(target.read_bytes()).hexdigest()

    def fetched(name: str, content: str = "") -> bytes:
        digest = hashlib.sha256((content or name).encode() * 1000).hexdigest()
        return StoredFile(f"s3://map/{name}", digest, 1000).fetched(cache).read_bytes()

    monkeypatch.setattr("vplog.maps.storage.objects.fetch", fetch)
    for number, name in enumerate("abacde"):
        assert fetched(name) == name.encode() * 1000
        os.utime(parts[-1].parent / hashlib.sha256(name.encode() * 1000).hexdigest(), (old + number, old + number))
    assert {file.read_text()[0] for file in files(cache)} == {"c", "d", "e"}, "one more than is kept"
    assert len(parts) == 5
    fetched("c")
    fetched("f")
    assert {file.read_text()[0] for file in files(cache)} == {"c", "e", "f"}, "what was read last"
    for given in (("x", ""), ("y", "z")):
        with pytest.raises(ResultError, match=r"reset|damaged"):
            fetched(*given)
    assert not any(file.name.startswith(".") for file in files(cache))
    parts[0].touch()
    os.utime(parts[0], (old, old))
    cache.trim()
    assert not parts[0].exists()


def test_several_read_and_trim_at_once(root: Any, cache: Cache) -> None:
    """With room for next to nothing: what one takes away another has open, or fetches anew."""
    cache = replace(cache, max_bytes=1000)

    def read(_: int) -> set[str]:
        with map_store.reading(root, cache) as store:
            drives = [store.run(drive) for drive in store.drives()]
            return {sha256_of(run / "descriptors.parquet") for run in drives}

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(read, range(12)))
    assert all(one == found[0] for one in found)
    assert len(found[0]) == 2
    assert sum(path.stat().st_size for path in files(cache)) <= 1000


KILLED = """
import sys, time
from pathlib import Path
from vplog.maps.storage import map_store as store
from vplog.maps.storage.download_cache import cache_in
from vplog.storage.remote_path import RemotePath, located
root, cache = located(sys.argv[1]), cache_in(Path(sys.argv[2]), 1.0)
with store.reading(root, cache) as reader, store.reading(root) as other:
    print(reader.root, other.root, flush=True)
    time.sleep(600)
"""


def test_what_a_killed_reader_leaves_goes_and_a_living_one_keeps_its_own(root: Any, tmp_path: Path) -> None:
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    line = [sys.executable, "-c", KILLED, str(root), str(tmp_path / "cache")]
    readers = [subprocess.Popen(line, stdout=subprocess.PIPE, text=True, env=environment) for _ in range(2)]
    said = [reader.stdout.readline().split() for reader in readers if reader.stdout]
    dead, living = ([Path(folder) for folder in one] for one in said)
    readers[0].kill()
    readers[0].wait()
    assert all(folder.is_dir() for folder in dead + living)
    code = KILLED.replace("time.sleep(600)", "")
    subprocess.run([sys.executable, "-c", code, *line[3:]], check=True, env=environment, stdout=subprocess.DEVNULL)
    assert not any(folder.exists() for folder in dead)
    assert all(folder.is_dir() for folder in living)
    readers[1].kill()
    readers[1].wait()
    for reader in readers:
        if reader.stdout:
            reader.stdout.close()


def test_a_folder_is_chosen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, verb: Verb) -> None:
    for name in ("VPLOG_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    places = [tmp_path / "home" / ".cache" / "vplog", tmp_path / "xdg" / "vplog", tmp_path / "own", tmp_path / "told"]
    for place, name in zip(places, ("", "XDG_CACHE_HOME", "VPLOG_CACHE", ""), strict=True):
        if name:
            monkeypatch.setenv(name, str(place.parent if name.startswith("XDG") else place))
        found = cache_in(place if place.name == "told" else None, 0.5)
        assert found == Cache(place / "maps", 500_000_000)
        assert place.is_dir()
        assert place.stat().st_mode & 0o777 == 0o700
    assert cache_in(tmp_path / "never", 0.0) is None
    assert not (tmp_path / "never").exists()
    (tmp_path / "file").touch()
    monkeypatch.setenv("VPLOG_CACHE", str(tmp_path / "file"))
    assert cache_in(None, 1.0) is None
    error = verb("map", "index", "s3://bucket/map", "--cache", tmp_path / "file").error
    assert "Cannot use the cache" in error
    assert "--cache" in verb("map", "index", "s3://bucket/map", "--cache-gb", 0).error
    assert verb("map", "index", "s3://bucket/map", "--cache", "s3://bucket/cache").code == 2
    assert verb("map", "index", "s3://bucket/map", "--cache-gb", "-1").code == 2
