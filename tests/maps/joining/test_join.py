"""What joins the drives of a map, on the small drive cut in two and one from elsewhere."""

from __future__ import annotations

import hashlib
import json
import pickle
import shutil
from concurrent.futures import Executor, Future
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest

from tests.joined import LOGS, QUICK
from vplog.data import Ranking
from vplog.errors import ResultError
from vplog.evaluate.truth import read_truth
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.joint.graph import JoinSettings
from vplog.loops.false_rate import FalseRateSettings
from vplog.loops.propose import ProposeSettings, propose
from vplog.maps.joining import candidate_drives as candidates
from vplog.maps.joining import components as component_folders
from vplog.maps.joining import drive_pairs
from vplog.maps.joining import join as map_join
from vplog.maps.joining.inter_session import Candidates, candidates_among, likely_drives, proposed_in, with_proposals
from vplog.maps.joining.join import read_drives
from vplog.maps.joining.join_states import read_states
from vplog.maps.joining.joint_record import components_in
from vplog.maps.merge import merge_maps
from vplog.maps.search.index import update_index
from vplog.maps.storage import map_store
from vplog.pipeline import load_pipeline
from vplog.results import run_record, tables
from vplog.results.run_record import read_run_json
from vplog.storage.compressed_json import read_compressed
from vplog.storage.input_hashes import hash_inputs

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    from vplog.stages import CodedState
    from vplog.verbs.demo.record import Demo

PIPELINE = load_pipeline("default", QUICK)
HALVES = ("before", "after")
STATES_FILE = "joins/states-00000.json.gz"


def put(root: Path, joint: Path, *names: str, **changes: Any) -> None:
    """Drives of the joint run into the map, as a batch does it."""
    digest = json.loads((joint / "library" / "library.json").read_text())["hash"]
    with map_store.writing(root) as store:
        if not (root / "map.json").exists():
            shutil.copytree(joint / "library", store.staging / "library")
            map_store.add_library(store, store.staging / "library", digest)
            store.write_head(map_store.Head(digest, PIPELINE.model_dump(mode="json")))
        for name in names:
            log, made = joint.parent / LOGS[name], store.staging / name
            shutil.copytree(joint / name, made)
            cache = root / ".cache" / f"drive={name}"
            cache.parent.mkdir(exist_ok=True)
            shutil.copytree(joint / ".cache" / name, cache)
            about = {"drive": name, "log": str(log), "key": name, "library": digest, "inputs": hash_inputs(log)}
            run_record.write_run_json(made / "drive.json", {**about, **changes})
            map_store.publish(store, name, made)


def joined(root: Path, executor: Executor | None = None) -> dict[str, Any]:
    with map_store.writing(root) as store:
        return map_join.join(store, PIPELINE, Execution(2), executor)


def digests(root: Path) -> dict[str, str]:
    """sha256 of all that a join writes, by name."""
    files = [path for path in sorted(root.rglob("*")) if path.relative_to(root).parts[0].startswith("joi")]
    return {
        path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
        if path.is_file()
    }


@pytest.fixture(scope="module")
def whole(joint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of the three, joined. Tests leave it as it is."""
    root = tmp_path_factory.mktemp("whole") / "map"
    put(root, joint, *LOGS)
    told = joined(root)
    assert told["warnings"] == []
    return root


@pytest.fixture
def copy(whole: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole, tmp_path / "map")


class Elsewhere(Executor):
    """Runs what it is given at once, in the form that it would have in another process, and back."""

    def __init__(self) -> None:
        self.tasks = 0

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.tasks += 1
        future: Future[Any] = Future()
        function, there = pickle.loads(pickle.dumps((fn, args)))  # noqa: S301
        try:
            future.set_result(pickle.loads(pickle.dumps(function(*there, **kwargs))))  # noqa: S301
        except Exception as error:
            future.set_exception(error)
        return future


def test_the_halves_of_a_drive_are_one_component(whole: Path, drive: Demo) -> None:
    [component] = components_in(map_store.Store(whole)) or []
    assert component["drives"] == ["after", "before"]
    folder = whole / "joint" / component["folder"]
    told = read_run_json(folder / "component.json")
    assert [(tie["query_drive"], tie["match_drive"]) for tie in told["joins"]] == [("before", "after")]
    assert told["joins"][0]["kept"] >= 3
    assert json.loads((whole / "joint.json").read_text())["alone"] == ["drive"]

    known = read_truth(drive.truth)
    poses = {name: tables.read_keyframes(folder / f"drive={name}" / "keyframes.parquet") for name in HALVES}
    first, start = poses["after"]
    truth = {
        name: se3.interpolate_at(known.stamp_ns, known.world_from_body, keyframes.stamp_ns)
        for name, (keyframes, _) in poses.items()
    }
    for name, (_, world_from_body) in poses.items():
        found = se3.between(start[0], world_from_body)[:, :3, 3]
        assert np.linalg.norm(found - se3.between(truth["after"][0], truth[name])[:, :3, 3], axis=1).max() < 4.0
    ledger = tables.read_joins(folder / "joins.parquet")["before", "after"]
    assert np.nansum(ledger.weight) == told["joins"][0]["kept"]
    assert first.drive == "after"


def test_a_drive_added_to_a_map_touches_its_own_alone(whole: Path, joint: Path, tmp_path: Path) -> None:
    """And whoever verifies, in one batch or in two, it ends with the same bytes; later without logs or features."""
    root, elsewhere = tmp_path / "map", Elsewhere()
    put(root, joint, "after")
    assert joined(root)["components"] == []
    before, states = digests(root), read_compressed(root / STATES_FILE)
    put(root, joint, "before", "drive")
    shutil.rmtree(root / ".cache" / "drive=after")
    told = joined(root, elsewhere)
    assert told["searched"] == ["before", "drive"]
    assert elsewhere.tasks == told["pairs_computed"] + 2, "the pairs, and how the two see"
    after = digests(root)
    assert {name: text for name, text in after.items() if name in before} == {**before, STATES_FILE: after[STATES_FILE]}
    assert read_compressed(root / STATES_FILE)[:1] == states
    assert after == digests(whole)
    assert joined(root)["pairs_computed"] == 0
    assert digests(root) == after


def test_what_is_killed_goes_on_to_the_same_bytes(whole: Path, copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Killed(BaseException):
        pass

    def killed(*_: Any, **__: Any) -> None:
        raise Killed

    for path in [copy / "joint.json", *copy.glob("joins/states-*")]:
        path.unlink()
    shutil.rmtree(copy / "joint")
    (copy / "joins" / "drive=drive" / "match=after.parquet").unlink()
    for module, name in (
        (map_join, "write_states"),
        (drive_pairs, "put_ledger"),
        (map_join, "_record_pairs"),
        (component_folders, "write_states"),
        (run_record, "write_run_json"),
        (component_folders, "write_joint"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, killed)
            with pytest.raises(Killed):
                joined(copy)
    told = joined(copy)
    assert told["pairs_computed"] == 0, "what was verified before the kill is not verified again"
    assert digests(copy) == digests(whole)


def test_what_is_damaged_is_made_again(whole: Path, copy: Path) -> None:
    """A bit that flips in the middle of each table and record: the next join writes the same files again."""
    wanted = digests(whole)
    for pattern in ("joint/*/drive=after/*", "joins/*/match=*"):
        for path in [*copy.glob("joint/*/joins.parquet"), *copy.glob(pattern)]:
            data = bytearray(path.read_bytes())
            data[len(data) // 2] ^= 4
            path.write_bytes(data)
        joined(copy)
        assert digests(copy) == wanted


def test_a_drive_that_is_removed_is_out_of_the_joint_graph(copy: Path) -> None:
    for folder in copy.glob("*/drive=after"):
        shutil.rmtree(folder)
    told = joined(copy)
    assert told["searched"] == ["before", "drive"], "candidates that were in it may be in others now"
    assert (told["pairs_computed"], told["components"]) == (1, [])
    assert joined(copy)["searched"] == []
    assert not list(copy.glob("joint/*"))
    assert not list(copy.glob("joins/*/match=after.parquet"))
    assert (copy / "joins" / "drive=drive" / "match=before.parquet").exists()


def test_a_drive_that_was_replaced_is_said(copy: Path, verb: Callable[..., Said]) -> None:
    assert "replaced" not in verb("map", "info", copy).err
    record = copy / "runs" / "drive=after" / "drive.json"
    run_record.write_run_json(record, {**run_record.read_run_json(record), "key": "of another log"})
    assert "after was replaced after" in verb("map", "info", copy).err
    path = copy / "joint.json"
    joint = run_record.read_run_json(path)
    joint["groups"][0]["components"] = [{"folder": "x", "drives": 3}]
    path.write_text(json.dumps(joint))
    assert "joint.json is damaged" in verb("map", "info", copy).err


@pytest.mark.parametrize("name", ["..", "/etc", "a/../../b", "", 7])
def test_a_record_that_names_other_folders_is_refused(
    copy: Path, joint: Path, drive: Demo, verb: Callable[..., Said], tmp_path: Path, name: str
) -> None:
    record = run_record.read_run_json(copy / "joint.json")
    record["groups"][0]["components"][0]["folder"] = name
    run_record.write_run_json(copy / "joint.json", record)
    with map_store.reading(copy) as store, pytest.raises(ResultError, match=r"joint\.json is damaged"):
        components_in(store)
    run = tmp_path / "run"
    run.mkdir()
    record = run_record.read_run_json(joint / "run.json")
    record["maps"][0]["drives"] = [name]
    run_record.write_run_json(run / "run.json", record)
    assert f"{run}/run.json names drives outside its folder" in verb("evaluate", run, "--truth", drive.truth).error


def test_a_query_says_what_cannot_be_found(copy: Path, drive: Demo, verb: Callable[..., Said], tmp_path: Path) -> None:
    command = ["map", "query", copy, drive.log]
    assert "fewer keyframes than the window of 99 views" in verb(*command, "--sequence", 99).err
    assert "is a folder: name a file" in verb(*command, "-o", tmp_path).err
    assert "length 4 is even" in verb(*command, "--sequence", 4).error
    shutil.rmtree(copy / "libraries")
    assert "has lost its library" in verb(*command).error


def test_a_merged_map_is_joined_without_logs(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    merge_maps([whole], tmp_path / "other")
    monkeypatch.setattr("vplog.maps.joining.members.stored_log", lambda *_: tmp_path / "gone.mcap")
    told = joined(tmp_path / "other")
    assert (told["warnings"], [one["drives"] for one in told["components"]]) == ([], [["after", "before"]])


def test_a_pair_without_its_log_is_left_out_and_tried_again(copy: Path) -> None:
    name = "match=after.parquet"
    ledger, expected = copy / "joins" / "drive=before" / name, digests(copy)
    ledger.unlink()
    shutil.rmtree(copy / ".cache")
    for path in copy.glob("joins/*/features.parquet"):
        path.unlink()
    record = copy / "runs" / "drive=before" / "drive.json"
    about = run_record.read_run_json(record)
    run_record.write_run_json(record, {**about, "log": "/gone.mcap"})
    told = joined(copy)
    assert told["components"] == []
    [warning] = told["warnings"]
    assert warning.startswith("before and after were not verified. The log of before /gone.mcap no longer exists")
    run_record.write_run_json(record, about)
    told = joined(copy)
    assert (told["searched"], told["pairs_computed"], told["warnings"]) == (["before"], 1, [])
    found = digests(copy)
    assert found == {path: text for path, text in expected.items() if not path.endswith("features.parquet")}


def test_drives_with_gps_are_kept_apart(joint: Path, tmp_path: Path) -> None:
    put(tmp_path / "map", joint, "after")
    path = tmp_path / "map" / "runs" / "drive=after" / "keyframes.parquet"
    keyframes, poses = tables.read_keyframes(path)
    settings = load_pipeline("default", [*QUICK, "gps.use=true"]).model_dump(mode="json")
    tables.write_keyframes(path, keyframes, poses, tables.TableMetadata(settings, ""))
    record = run_record.read_run_json(path.with_name("drive.json"))
    run_record.write_run_json(path.with_name("drive.json"), {**record, "files": {}})
    told = joined(tmp_path / "map")
    assert told["alone"] == ["after"]
    assert "was solved with GPS" in told["warnings"][0]


def test_a_map_is_joined_on_demand(copy: Path, verb: Callable[..., Said], tmp_path: Path) -> None:
    assert "together  after, before" in verb("map", "join", copy).out
    assert verb("map", "join", copy, "--json").json["pairs_computed"] == 0
    assert "is not a map" in verb("map", "join", tmp_path / "none").error
    (copy / "joint.json").write_text("{")
    assert verb("map", "join", copy, "--json").json["components"]


class Likeness:
    """Places are numbers, the more alike the closer."""

    def __init__(self, known: list[float] | None = None) -> None:
        self.known = np.array(known or [])

    def index(self, descriptors: list[float]) -> Likeness:
        return Likeness(descriptors)

    def query(self, descriptor: float, k: int, stop: int | None = None) -> Ranking:
        score = (1.0 / (1.0 + np.abs(self.known - descriptor))).astype(np.float32)
        rows = np.argsort(-score, kind="stable")[:k]
        return Ranking(rows.astype(np.int32), score[rows])


def test_candidates_are_bounded_over_all_drives() -> None:
    """The cap is of a query, whatever number of drives hold its place, and their order of search does not matter."""
    settings = load_pipeline("default", ["sequence.length=1", "propose.per_query=4"])
    random = np.random.default_rng(5)
    later = random.uniform(0, 100, 30).tolist()
    drives = [random.uniform(0, 100, 40).tolist() for _ in range(6)] + [later]
    found = []
    for order in (range(7), reversed(range(7))):
        candidates = Candidates(np.empty(0, np.int32), propose([], ProposeSettings()))
        for number in order:
            state: Any = Likeness()
            more = proposed_in(later, drives[number], state, settings, Execution())
            candidates = with_proposals(candidates, number, more, settings)
        found.append(candidates)
    for threads in (1, 3):
        like: Any = Likeness()
        searched = {7: range(7)}
        found.append(candidates_among({7: later}, drives.__getitem__, searched, like, settings, Execution(threads))[7])
    for one in found:
        proposals = one.proposals
        assert np.array_equal(one.drive, found[0].drive)
        assert np.array_equal(proposals.match, found[0].proposals.match)
        assert np.bincount(proposals.query).tolist() == [4] * 30
        assert np.array_equal(proposals.rank, np.tile(np.arange(4), 30))
        assert (np.diff(proposals.score.reshape(30, 4), axis=1) <= 0).all()
        assert (one.drive[proposals.rank == 0] == 6).all(), "the very same places are the most alike"
    assert 6 in likely_drives(found[0], JoinSettings(most_drives=1))
    assert len(likely_drives(found[0], JoinSettings(most_drives=3))) == 3
    assert likely_drives(found[0], JoinSettings(least_closures=1000)) == []


def test_of_many_drives_those_most_alike_are_searched(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The index tells them from the others by single views; of few drives every one is searched."""
    monkeypatch.setattr(candidates, "_CHOICE", 1)
    few = PIPELINE.model_copy(update={"join": JoinSettings(most_drives=1)})
    with map_store.reading(copy) as store:
        drives = read_drives(store, {})
        other = next(name for name in drives.names if name not in HALVES)
        members = {name: drives.records[name] for name in (other, *HALVES)}
        state = map_join.load_places(store.library(drives.library), few)
        later = {number: candidates.places_of(store, list(members)[number], state) for number in (1, 2)}
        assert candidates.drives_to_search(store, members, later, state, few) == {1: [0], 2: [1]}
        every = candidates.drives_to_search(store, members, later, state, PIPELINE)
        assert every == {1: [0], 2: [0, 1]}
        for threads in (1, 3):
            found = candidates.candidates_of(store, members, [2], state, few, Execution(threads))[2]
            assert set(found.drive.tolist()) == {1}


def test_the_index_of_drives_that_are_not_joined_stays(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As of pictures, which a join searches for nothing."""
    monkeypatch.setattr(candidates, "_CHOICE", 0)
    monkeypatch.setattr("vplog.maps.search.index.CAPACITY", 1)  # a segment for each drive
    few = PIPELINE.model_copy(update={"join": JoinSettings(most_drives=1)})
    with map_store.reading(copy) as store:
        drives = read_drives(store, {})
        state = cast("CodedState", map_join.load_places(store.library(drives.library), few))
        update_index(store, store.drives(), state)
        before = {path.name for path in store.index.iterdir()}
        members = {name: about for name, about in store.drives().items() if name != drives.names[0]}
        later = {1: candidates.places_of(store, list(members)[1], state)}
        candidates.drives_to_search(store, members, later, state, few)
        assert {path.name for path in store.index.iterdir()} == before


def test_a_rate_that_leaves_no_closure_between_drives_says_so(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As with the features of a network, of which no candidate is mirrored."""
    monkeypatch.setattr(map_join, "_out_of_date", lambda *_: [])
    held = FalseRateSettings(rate=0.1, null_pairs=0)
    for rate, said in ((held, True), (FalseRateSettings(rate=0.1), False), (FalseRateSettings(null_pairs=0), False)):
        with map_store.writing(copy) as store:
            record = map_join.join(store, PIPELINE.model_copy(update={"false_rate": rate}))
        assert any("--false-rate 0.1: no closure between drives" in text for text in record["warnings"]) == said


def test_drives_that_satellites_tell_apart_are_not_compared(copy: Path) -> None:
    """Bounds of half a degree around the antimeridian; a drive without fixes may be anywhere."""
    with map_store.reading(copy) as store:
        drives = read_drives(store, {})
        state = map_join.load_places(store.library(drives.library), PIPELINE)
        records = {f"{number}": {**drives.records["after"], "earth": None} for number in range(5)}
        for name, bounds in (
            ("0", [10, 179, 11, 179.999]),
            ("1", [10, -179, 11, -178]),
            ("3", [10, -179.9999, 11, -179]),
        ):
            records[name]["earth"] = {"bounds": bounds}
        later = {number: candidates.places_of(store, "after", state) for number in (3, 4)}
        near = candidates.drives_to_search(store, records, later, state, PIPELINE)
    assert near == {3: [0, 1, 2], 4: [0, 1, 2, 3]}
    far = PIPELINE.model_copy(update={"join": JoinSettings(apart_m=1.0)})
    with map_store.reading(copy) as store:
        assert candidates.drives_to_search(store, records, later, state, far)[3] == [1, 2]


def test_a_drive_that_comes_back_is_a_new_one(halves: Path, tmp_path: Path) -> None:
    """Others may have come meanwhile, which its old place in the order would leave it uncompared with."""
    root = tmp_path / "map"
    shutil.copytree(halves, root)
    with map_store.writing(root) as store:
        map_store.remove(store, ["before"])
        assert set(read_states(store)) == {"before", "after"}
        read_drives(store, {})
        assert set(read_states(store)) == {"after"}
