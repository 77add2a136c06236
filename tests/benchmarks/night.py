"""New drives put into a map of many and joined: what that reads and takes, by the drives of the map.

The map is a city of short roads, a hundred metres from one another: drives of twenty keyframes, twelve of each road,
whatever their number. What is verified is made up, four closures with each other drive of the road and none elsewhere,
since it does not depend on the map. The drives before have been joined, the records of that are written here.
"""

from __future__ import annotations

import os
import resource
import shutil
import sys
import tempfile
import time
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.benchmarks.city import undecided, write_odometry
from tests.benchmarks.measure import Figure
from tests.benchmarks.scale import made_up_library
from tests.benchmarks.search import Places, make_places, seen_again
from vplog.data import Closures, Keyframes, Verdict
from vplog.execution.execution import Execution
from vplog.maps.joining import drive_pairs, join
from vplog.maps.joining.components import folders_of, groups_of
from vplog.maps.joining.join_states import JoinState, write_states
from vplog.maps.joining.joint_record import write_joint
from vplog.maps.joining.members import CameraTrust, member_of
from vplog.maps.search.index import update_index
from vplog.maps.storage import map_store
from vplog.maps.storage.layout import folder_name, sha256_of
from vplog.pipeline import load_pipeline
from vplog.places.bobb import BobbSettings, Place
from vplog.results import run_record, tables
from vplog.storage.scratch import files_in

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from vplog.maps.storage.contents import Store
    from vplog.places.bobb import BobbState

EACH, PASSES, CLOSURES = 20, 12, np.arange(0, 20, 5)
FILES_BAR = 0.05
"""Opened files but twenty, by drives of the map, of a join of nothing new."""
_LINKS = 10_000
"""Drives that share the files of one run: ext4 has at most 65,000 links of a file, and a map makes more of each."""
_MOST = 40
"""Drives that are added."""
_ABOUT_DEG = 0.001
"""From one road to the next."""


class Night:
    """A map of a city, in a folder, and its next drives."""

    def __init__(self, root: Path, drives: int, *, fixes: bool, seed: int = 0) -> None:
        self.settings, self.random, self.fixes = BobbSettings(), np.random.default_rng(seed), fixes
        self.state: BobbState = made_up_library(self.settings)
        self.roads, self.drives, self.root = -(-drives // PASSES), drives, root
        self.side = int(np.ceil(np.sqrt(self.roads)))
        self.base: dict[int, Places] = {}
        self.run = root.parent / f"{root.name}-run"
        self.pipeline = load_pipeline("default")
        _write_tables(self.run, self.pipeline)
        self.sizes = {
            n: {"bytes": (self.run / n).stat().st_size, "sha256": sha256_of(self.run / n)} for n in files_in(self.run)
        }
        with map_store.writing(root) as store:
            made = store.staging / "library"
            self.state.save(made)
            map_store.add_library(store, made, self.state.hash)
            store.write_head(map_store.Head(self.state.hash, self.pipeline.model_dump(mode="json")))
            for number in range(drives):
                self.write(store.root / "runs" / folder_name(name_of(number)), number)
        with map_store.writing(root) as store:  # linked, in the catalogue, indexed and joined
            update_index(store, store.drives(), self.state, Execution(2))
            self._join(store)

    def write(self, run: Path, number: int) -> None:
        """The run folder of a drive."""
        run.mkdir(parents=True)
        linked = self.run.with_name(f"{self.run.name}-{number // _LINKS}")
        if not linked.exists():
            shutil.copytree(self.run, linked)
        for name in self.sizes:
            os.link(linked / name, run / name)
        road = number % self.roads
        if road not in self.base:
            self.base[road] = make_places(EACH, self.settings, seed=1000 + road)
        other = make_places(EACH, self.settings, seed=10**6 + number, drive=1)
        places = [
            seen_again(
                self.base[road], row, Place(other.references[row], other.weights[row], other.boxes[row]), self.random
            )
            for row in range(EACH)
        ]
        about = tables.TableMetadata(self.settings.model_dump(mode="json"), self.state.hash)
        tables.write_descriptors(run / "descriptors.parquet", _KEYFRAMES, self.state.to_arrow(places), about)
        own = {"bytes": (run / "descriptors.parquet").stat().st_size, "sha256": sha256_of(run / "descriptors.parquet")}
        south, west = 48.0 + _ABOUT_DEG * (road // self.side), 11.0 + _ABOUT_DEG * (road % self.side)
        record = {
            "drive": name_of(number), "log": f"/logs/{number}.mcap", "key": f"{number:064x}", "inputs": {"log": "one"},
            "library": self.state.hash, "topics": {}, "files": {**self.sizes, "descriptors.parquet": own},
            "earth": {"origin": [48.0, 11.0, 0.0], "enu_from_world": np.eye(4).tolist(),
                      "bounds": [south, west, south + 1e-5, west + 1e-5]} if self.fixes else None,
        }  # fmt: skip
        run_record.write_run_json(run / "drive.json", record)

    def _join(self, store: Store) -> None:
        made_from, records = drive_pairs.search_key(self.pipeline), store.drives()
        member = member_of(store, records[name_of(0)])  # all drives are of one log, and have one key
        met, states = {(self.drives + one) % self.roads for one in range(_MOST)}, list[JoinState]()
        for number in range(self.drives):
            name, before = name_of(number), range(number % self.roads, number, self.roads)
            pairs = tuple(
                {"match": name_of(one), "match_key": member.key, "candidates": EACH, "verified": len(CLOSURES),
                 "ledger": _key(number, one)}
                for one in before
            )  # fmt: skip
            states.append(JoinState(name, number, member.key, records[name]["key"], False, made_from, pairs))
            camera = CameraTrust({"matrix": np.eye(3).tolist()}, 0.0)
            drive_pairs.put_camera(store, replace(member, drive=name), self.pipeline, camera)
            if number % self.roads in met:  # the ledgers of others are not read
                for one in before:
                    path = drive_pairs.ledger_path(store, name, name_of(one))
                    path.write_bytes(_ledger(name, name_of(one), _key(number, one)))
        write_states(store, states, {one.drive for one in states})
        drives = join.read_drives(store, {})
        work = join._Work(store, drives, [], self.pipeline, Execution(1), None, False)
        groups = groups_of(drives, join._current_ledgers(work), self.pipeline)
        solved, judged = [], {}
        for group in groups:
            component = {"folder": f"component={group.key[:16]}", "drives": list(group.drives)}
            for name in folders_of(component):
                run_record.write_run_json(store.root / "joint" / name / "component.json", {})
            solved.append({"key": group.key, "drives": list(group.drives), "components": [component], "apart": []})
            judged |= group.judged
        write_joint(store.root, {"groups": solved, "alone": [], "apart": {}, "keys": {}, "judged": judged})

    def add(self, count: int) -> dict[str, Any]:
        """Put in that many drives more, and join them; what it took."""
        made, cost = [self.root.parent / f"made-{self.drives + one}" for one in range(count)], Cost(self.root)
        for number, folder in enumerate(made, self.drives):
            self.write(folder, number)
        cost.begin()
        with map_store.writing(self.root) as store:
            for number, folder in enumerate(made, self.drives):
                map_store.publish(store, name_of(number), folder)
            with _made_up(self.roads), undecided():
                record = join.join(store, self.pipeline, Execution(1))
        cost.end()
        assert len(record["searched"]) == count, record["searched"][:5]
        found = max((len(one["drives"]) for one in record["components"]), default=0)
        self.drives += count
        return {
            **cost.facts,
            "pairs": record["pairs_computed"],
            "largest": found,
            "stages": record["stages"],
            "warnings": record["warnings"][:2],
        }


class Cost:
    """Files opened in a folder, bytes read and processor time."""

    watched: Cost | None = None

    def __init__(self, root: Path) -> None:
        self.root, self.facts, self.opened = str(root), dict[str, Any](), 0
        self.begin()

    def begin(self) -> None:
        Cost.watched, self.opened = self, 0
        self._began = time.process_time(), _read_bytes()

    def end(self) -> None:
        Cost.watched = None
        seconds, read = time.process_time() - self._began[0], _read_bytes() - self._began[1]
        self.facts = {"files": self.opened, "MB": round(read / 1e6, 2), "cpu_s": round(seconds, 2)}


def _read_bytes() -> int:
    return int(Path("/proc/self/io").read_text().split()[1])


def _audited(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "open" and Cost.watched is not None and str(arguments[0]).startswith(Cost.watched.root):
        Cost.watched.opened += 1


sys.addaudithook(_audited)
_STAMPS = np.arange(EACH, dtype=np.int64) * 10**9
_POSES = np.tile(np.eye(4), (EACH, 1, 1))
_POSES[:, 0, 3] = np.arange(EACH)
_KEYFRAMES = Keyframes("", _STAMPS, _POSES)


def name_of(number: int) -> str:
    return f"d{number:06d}"


def _write_tables(run: Path, pipeline: Any) -> None:
    run.mkdir(parents=True)
    about = tables.TableMetadata(pipeline.model_dump(mode="json"), "a" * 64)
    write_odometry(run, _KEYFRAMES, 1e4 * np.eye(6), about)
    run_record.write_run_json(
        run / "run.json", {"finished": True, "topics": {}, "settings": pipeline.model_dump(mode="json")}
    )


def _key(later: int, earlier: int) -> str:
    return f"{later:032x}{earlier:032x}"


def _ledger(later: str, earlier: str, key: str, rows: np.ndarray = CLOSURES) -> bytes:
    count = len(rows)
    numbers, shares, nan = np.zeros(count, np.int32), np.zeros(count, np.float32), np.full(count, np.nan)
    ledger = Closures(
        query=rows.astype(np.int32), match=rows.astype(np.int32), rank=numbers, score=shares, support=numbers,
        shared_references=[np.empty(0, np.uint16)] * count, shared_overlap=[np.empty(0, np.float32)] * count,
        matches=numbers, landmarks=numbers, inliers=numbers, spread=shares, reverse_inliers=numbers,
        scale=["depth"] * count, match_from_query=np.tile(np.eye(4), (count, 1, 1)),
        information=np.tile(np.eye(6) * 1e3, (count, 1, 1)), verdict=[Verdict.ACCEPTED] * count, p_false=nan,
        residual_before=nan, residual_after=nan, weight=nan, query_camera=numbers, match_camera=numbers,
    )  # fmt: skip
    ends = (Keyframes(later, _STAMPS, _POSES), Keyframes(earlier, _STAMPS, _POSES), ledger)
    return tables.joins_as_bytes([ends], tables.TableMetadata({}, "a" * 64), key)


def _verified(task: Any, roads: int) -> bytes:
    later, earlier = task.later.drive, task.earlier.drive
    met = (int(later[1:]) - int(earlier[1:])) % roads == 0
    return _ledger(later, earlier, task.key, CLOSURES if met else CLOSURES[:0])


@contextmanager
def _made_up(roads: int) -> Iterator[None]:
    """What is verified is not looked at."""
    before = drive_pairs.compute_pair, drive_pairs.compute_camera
    camera = CameraTrust({"matrix": np.eye(3).tolist()}, 0.0)
    drive_pairs.compute_pair = partial(_verified, roads=roads)
    drive_pairs.compute_camera = lambda *_, **__: camera
    try:
        yield
    finally:
        drive_pairs.compute_pair, drive_pairs.compute_camera = before


def night(sizes: Sequence[int], fixes: bool) -> Iterator[Figure]:
    """Nothing new, ten and thirty drives put into maps of these sizes."""
    for size in sizes:
        with tempfile.TemporaryDirectory() as folder:
            made = Night(Path(folder) / "map", size, fixes=fixes)
            for count in (0, 10, 30):
                facts = made.add(count)
                facts["peak_MB"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000)
                name, bar = f"{count} more in {made.drives - count}, files", None if count else FILES_BAR
                yield Figure(
                    f"{name} but twenty, a drive of the map", max(facts["files"] - 20, 0) / size, bar, True, facts
                )
