"""Joins of a map on an object store: what is near is fetched, and nothing else."""

from __future__ import annotations

import pickle
from concurrent.futures import Executor, Future
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import vplog
from tests.maps.bucket import counting, serving
from tests.maps.joining.test_join import LOGS, PIPELINE, joined, put
from vplog.execution.execution import Execution
from vplog.joint.graph import JoinSettings
from vplog.maps.info import describe_map
from vplog.maps.joining import candidate_drives
from vplog.maps.joining import join as map_join
from vplog.maps.joining.joint_record import joint_components, keyframe_poses
from vplog.maps.merge import merge_maps
from vplog.maps.search.index import update_index
from vplog.maps.search.query import MapQuery, search
from vplog.maps.search.sequences import LineSearch
from vplog.maps.storage import map_store
from vplog.maps.storage.download_cache import cache_in
from vplog.maps.storage.remote_map import StoredFile
from vplog.storage.remote_path import located

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from vplog.verbs.demo.record import Demo


@pytest.fixture(scope="module")
def server() -> Iterator[None]:
    with serving():
        yield


@pytest.fixture(scope="module")
def whole(joint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("whole") / "map"
    put(root, joint, *LOGS)
    joined(root)
    return root


@pytest.fixture
def root(server: None, whole: Path, request: pytest.FixtureRequest) -> Any:
    """The drives of the map in a bucket, not joined."""
    root: Any = located(f"s3://bucket/{request.node.name}")
    merge_maps([whole], root)
    return root


def rest(root: Any) -> set[str]:
    with map_store.reading(root) as store:
        assert store.mirror is not None
        return set(store.mirror.manifest.now["rest"])


def poses(root: Any) -> dict[str, Any]:
    with map_store.reading(root) as store:
        found = joint_components(store)
        return {drive: keyframe_poses(store, found, drive).tolist() for drive in store.drives()}


def test_it_is_joined_as_in_a_folder(root: Any, whole: Path, drive: Demo) -> None:
    assert joined(root)["components"][0]["drives"] == ["after", "before"]
    assert poses(root) == poses(whole)
    (there, here) = (vplog.evaluate(place, drive.truth) for place in (root, whole))
    assert there["components"] == here["components"] != []
    assert [one["between"] for one in there["drives"]] == [one["between"] for one in here["drives"]]
    assert describe_map(root)["bytes"] > 0
    assert {name for name in rest(root) if name.startswith("joins/states-")} == {"joins/states-00000.json.gz"}
    with counting() as asked:
        told = joined(root)
    assert (told["searched"], told["pairs_computed"]) == ([], 0)
    assert asked["PUT"] <= 3, "nothing new is written"
    with map_store.writing(root) as store:
        map_store.remove(store, ["after"])
    assert joined(root)["components"] == []
    assert not [name for name in rest(root) if "after" in name or name.startswith("joint/")]


def test_drives_that_do_not_change_are_not_fetched(root: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of more drives than are checked one by one."""
    few = PIPELINE.model_copy(update={"join": JoinSettings(judged_anew=2)})
    with map_store.writing(root) as store:
        map_join.join(store, few)
    joint, read = poses(root), set[str]()
    fetched = map_store.Mirror._fetch_file

    def noted(self: Any, place: Any, target: Any, about: Any) -> str:
        read.add(target.relative_to(self.local).as_posix())
        return fetched(self, place, target, about)

    monkeypatch.setattr(map_store.Mirror, "_fetch_file", noted)
    with map_store.writing(root) as store:
        assert map_join.join(store, few)["searched"] == []
    assert read == {"joint.json", "joins/states-00000.json.gz"}
    assert poses(root) == joint


def test_the_index_is_in_the_bucket(root: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A writer that searches by it puts it there, and a reader takes it in place of what it is made of."""
    monkeypatch.setattr(candidate_drives, "_CHOICE", 1)
    few = PIPELINE.model_copy(update={"join": JoinSettings(most_drives=1, least_closures=1)})
    with map_store.writing(root) as store:
        map_join.join(store, few)
    [name] = [name for name in rest(root) if name.startswith("index/")]
    with map_store.reading(root, cache_in(tmp_path)) as store:
        library, drives = map_store.common_library(store)
        state: Any = few.places.load(store.library(library), Execution())
        parts, warnings = update_index(store, drives, state)
        assert not list(store.root.glob("runs/*/descriptors.parquet"))
        assert (warnings, [part.path.name for part in parts if part.path]) == ([], [name.removeprefix("index/")])
        assert sorted(parts[0].numbers.tolist()) == [0, 1, 2]
        views: Any = candidate_drives.places_of(store, "after", state)
        here, _ = search(store, drives, state, views, MapQuery(3), LineSearch())
        sent = Sent(monkeypatch, tmp_path / "worker")
        there, _ = search(store, drives, state, views, MapQuery(3, executor=sent), LineSearch())
    assert sent.segments, "names go to workers, and no part of the index"
    assert {type(one) for one in sent.segments} == {StoredFile}
    assert list((tmp_path / "worker").glob("maps/objects/*"))
    for one in ("drive", "keyframe", "score"):
        assert np.array_equal(getattr(here, one), getattr(there, one))


class Sent(Executor):
    """A machine with a cache of its own."""

    def __init__(self, patch: pytest.MonkeyPatch, cache: Path) -> None:
        self.patch, self.cache, self.segments = patch, cache, list[Any]()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        data, future = pickle.dumps((fn, args, kwargs)), Future[Any]()
        self.segments += args[0].segments
        with self.patch.context() as patch:
            patch.setenv("VPLOG_CACHE", str(self.cache))
            function, given, options = pickle.loads(data)  # noqa: S301
            future.set_result(function(*given, **options))
        return future
