"""Components of many drives: a new one is placed among them, and the whole is solved again as they grow.

A component in joint.json then has, beside the folder of the last solve of the whole, the folders of drives that came or
moved since, `grown`. Each holds the tables of its drives in the frame of the component, the ledgers by which they were
placed, and no more. What is decided of a drive's closures stays while the drive, those that it met and the ledgers are
what they were: its entry in `judged`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Closures, Floats, Keyframes
from vplog.errors import GraphError, ResultError
from vplog.geometry import se3
from vplog.joint.graph import middle
from vplog.joint.growth import Anchored, place, solve_again, turned_round
from vplog.maps.joining import joint_graph
from vplog.maps.joining.joint_graph import SolvedDrive, verified, verified_closures, with_solve
from vplog.maps.joining.joint_record import count_between, fetch_poses, is_whole, joint_ledgers
from vplog.maps.storage.damage import reading_drive
from vplog.maps.storage.layout import folder_name
from vplog.maps.storage.map_store import Store
from vplog.refinement.refine import Refined
from vplog.results import tables
from vplog.storage.json_records import key_of

if TYPE_CHECKING:
    from vplog.pipeline import Pipeline


def _other(pair: tuple[str, str], drive: str) -> str:
    return pair[pair[0] == drive]


class LostPosesError(ResultError):
    """The poses of a drive in its component cannot be read."""

    def __init__(self, drive: str, why: str) -> None:
        super().__init__(why)
        self.drive = drive


@dataclass
class Part:
    """A component as it grows."""

    folders: dict[str, str]
    """Folder in MAP/joint of each drive, the one whose frame it is first; empty for one that is alone, in its own."""
    placed: set[str] = field(default_factory=set)
    """Drives that came or moved since the whole was solved."""
    between: Counter[str] = field(default_factory=Counter)
    """`count_between` of the component."""

    @property
    def record(self) -> dict[str, Any]:
        """The component in joint.json."""
        rest = [folder for drive, folder in self.folders.items() if drive not in self.placed]
        grown = {drive: self.folders[drive] for drive in self.folders if drive in self.placed}
        main = rest[0] if rest else next(iter(self.folders.values()))
        record = {"folder": main, "drives": list(self.folders), "between": dict(self.between)}
        return record | ({"grown": grown} if grown else {})


class Growth:
    """The components of a group of drives, to which drives are added one by one."""

    def __init__(
        self, store: Store, pipeline: Pipeline, header: tables.TableMetadata, judged: Mapping[str, str],
        known: Iterable[Mapping[str, Any]], stays: Sequence[str],
        pairs: Mapping[tuple[str, str], Callable[[], Closures]],
    ) -> None:  # fmt: skip
        """`known` are components of joint.json, and `stays` those of their drives that are unchanged. `judged` has, by
        drive, a hash of all that its closures are decided by; `pairs` read the ledger of each pair after geometric
        verification, before any joint solve.
        """
        self._store, self._pipeline, self._header, self._judged, self._pairs = store, pipeline, header, judged, pairs
        self.apart: dict[tuple[str, str], str] = {}
        self.reasons: list[str] = []
        self.failed: set[str] = set()
        """Drives that are tried again."""
        self._met: dict[str, list[tuple[str, str]]] = {}
        for pair in pairs:
            for one in pair:
                self._met.setdefault(one, []).append(pair)
        self._part: dict[str, Part] = {}
        left = set(stays)
        for one in known:
            grown = one.get("grown", {})
            there = {drive: grown.get(drive, one["folder"]) for drive in one["drives"] if drive in left}
            part = Part(there, set(grown) & set(there), Counter(one.get("between")))
            self._part |= dict.fromkeys(there, part)
            if there and len(there) < len(one["drives"]):  # what held the others together may be gone
                self._solve(part)
        self._part |= {drive: Part({drive: ""}) for drive in stays if drive not in self._part}

    def parts(self) -> list[Part]:
        """The components, of more than one drive."""
        return [one for one in {id(part): part for part in self._part.values()}.values() if len(one.folders) > 1]

    def records(self) -> list[dict[str, Any]]:
        """The components as joint.json has them, in order of their first drives."""
        return sorted((one.record for one in self.parts()), key=lambda one: one["drives"][0])

    def add(self, drives: Iterable[str]) -> None:
        """Place drives one after the other; what was alone is tried again when one that it has closures with is joined.
        Raises ResultError and DamagedDriveError."""
        waiting, parted = dict.fromkeys(drives), set[str]()
        while waiting:
            drive = next(iter(waiting))
            del waiting[drive]
            self._part[drive] = Part({drive: ""})
            joined = {drive, *(one for one, part in self._part.items() if len(part.folders) > 1)}
            if self._placed(drive):
                alone = {one for one, part in self._part.items() if len(part.folders) == 1}
                parted |= joined & alone  # by the whole, which would part them again
                others = {one for pair in self._met[drive] for one in pair} & alone - parted
                waiting |= dict.fromkeys(sorted(others))

    def _placed(self, drive: str) -> bool:
        """Place a drive by its closures with those that are there, and put together what it joins."""
        own, meets = self._drive(drive), dict[int, list[tuple[str, str]]]()
        for pair in self._met[drive]:
            if (part := self._part.get(_other(pair, drive))) is not None:
                meets.setdefault(id(part), []).append(pair)
        by_size = sorted(meets.values(), key=lambda pairs: -len(self._part[_other(pairs[0], drive)].folders))
        home, moved, ledgers = Part({drive: ""}), dict[str, "Floats"](), dict[tuple[str, str], "Closures"]()
        for met in by_size:
            part, found = self._part[_other(met[0], drive)], {pair: self._pairs[pair]() for pair in met}
            pairs = [pair for pair in met if len(verified(found[pair]))]
            if not pairs:
                continue
            between = [verified_closures(1, 0, found[pair]) for pair in pairs]
            between = [one if pair[0] == drive else turned_round(one) for pair, one in zip(pairs, between, strict=True)]
            poses = [self._keyframes(_other(pair, drive))[1] for pair in pairs]
            anchored = [Anchored(one, at[one.match]) for one, at in zip(between, poses, strict=True)]
            try:
                placed = place(own.graph, anchored, self._pipeline.solve, self._pipeline.join)
            except GraphError as error:
                self.reasons.append(f"{drive} cannot be placed. {error}")
                self.failed.add(drive)
                continue
            self.apart |= {pairs[at]: reason for at, reason in placed.apart.items()}
            if placed.world_from_body is None:
                continue
            for at, pair in enumerate(pairs):
                ledgers[pair] = with_solve(found[pair], placed.weight[at], placed.residual[at])
                home.between += count_between({pair: ledgers[pair]})
                if at not in placed.apart:
                    self.apart.pop(pair, None)
            home.between += part.between
            if not moved:
                home.folders, home.placed = {**part.folders, drive: ""}, set(part.placed)
                moved = {one: self._keyframes(one)[1] for one, folder in part.folders.items() if not folder}
                moved[drive] = placed.world_from_body
            else:  # a component more comes along as it is
                rows = np.concatenate(
                    [one.query[weight > 0.5] for one, weight in zip(between, placed.weight, strict=True)]
                )
                shift = middle(moved[drive][rows] @ se3.inverse(placed.world_from_body[rows]))
                moved |= {one: shift @ self._keyframes(one)[1] for one in part.folders}
                ledgers |= self._ledgers(part)
                home.folders |= part.folders
        if not moved:
            return False
        folder = self._write([self._judged[drive], home.folders, sorted(moved)], moved, {drive: own}, ledgers)
        home.folders |= dict.fromkeys(moved, folder)
        home.placed |= moved.keys()
        self._part |= dict.fromkeys(home.folders, home)
        if len(home.placed) > self._pipeline.join.grown_share * (len(home.folders) - len(home.placed)):
            self._solve(home)
        return True

    def solve_all(self) -> None:
        """Solve every component again that has grown."""
        for part in self.parts():
            if part.placed:
                self._solve(part)

    def _solve(self, part: Part) -> None:
        """Solve a component as a whole; what no closures hold together any more is parted."""
        fetch_poses(self._store, part.folders)
        names = list(part.folders)
        number = {drive: at for at, drive in enumerate(names)}
        own = [self._drive(drive) for drive in names]
        poses = [self._keyframes(drive)[1] for drive in names]
        graphs = [
            replace(one.graph, graph=replace(one.graph.graph, world_from_body=at))
            for one, at in zip(own, poses, strict=True)
        ]
        known = self._ledgers(part)
        between = [verified_closures(number[later], number[earlier], one) for (later, earlier), one in known.items()]
        weight = [np.nan_to_num(one.weight[verified(one)]) for one in known.values()]
        try:
            joined = solve_again(
                graphs, between, weight, self._pipeline.solve, self._pipeline.join, self._pipeline.refine
            )
        except GraphError as error:  # it stays as it is
            self.reasons.append(f"{len(names)} drives from {names[0]} on cannot be solved as a whole. {error}")
            return
        judged = dict(zip(known, map(with_solve, known.values(), joined.weight, joined.residual), strict=True))
        made_from = [part.folders, [self._judged[drive] for drive in names]]
        for members in joined.maps:
            inside = [names[at] for at in members]
            if len(members) == 1:
                self._part |= {inside[0]: Part({inside[0]: ""})}
                continue
            solved = {names[at]: joined.world_from_body[at] for at in members}
            ledgers = {pair: one for pair, one in judged.items() if solved.keys() >= set(pair)}
            drives = {names[at]: own[at] for at in members}
            folder = self._write([made_from, inside], solved, drives, ledgers, joined.solved[members])
            self._part |= dict.fromkeys(inside, Part(dict.fromkeys(inside, folder), between=count_between(ledgers)))

    def _ledgers(self, part: Part) -> dict[tuple[str, str], Closures]:
        """The verified closures of all pairs of a component, as they were decided; of pairs whose drives were not in
        one component then, as rejected."""
        found = joint_ledgers(self._store, {*part.folders.values()} - {""})
        pairs = [pair for pair in self._pairs if pair[0] in part.folders and pair[1] in part.folders]
        known = {pair: found[pair] if pair in found else self._pairs[pair]() for pair in pairs}
        return {pair: one.rows(rows) for pair, one in known.items() if len(rows := verified(one))}

    def _write(
        self, made_from: Any, poses: Mapping[str, Floats], known: Mapping[str, SolvedDrive],
        ledgers: dict[tuple[str, str], Closures], refined: Refined | None = None,
    ) -> str:  # fmt: skip
        """Write a folder of MAP/joint for these drives, and return its name."""
        name = f"component={key_of(made_from)[:16]}"
        if is_whole(self._store, name, list(poses)):  # of a join that was killed; its name says that it is the same
            return name
        drives = {drive: known.get(drive) or self._drive(drive) for drive in poses}
        keyframes = {one: self._keyframes(one)[0] for one in set(chain.from_iterable(ledgers))}
        rows = [(keyframes[later], keyframes[earlier], one) for (later, earlier), one in ledgers.items()]
        record = {
            "drives": list(poses),
            "joins": [joint_graph.pair_record(*pair, one) for pair, one in ledgers.items()],
        }
        if refined is not None:
            record = joint_graph.solution_record(list(poses), [], refined)
        about = {**record, "made_from": key_of(made_from)}
        joint_graph.write_component(self._store, name, drives, poses, rows, about, self._header)
        return name

    def _drive(self, drive: str) -> SolvedDrive:
        return joint_graph.read_drive(drive, self._store.run(drive))

    def _keyframes(self, drive: str) -> tuple[Keyframes, Floats]:
        """The keyframes of a drive, and their poses (N, 4, 4) in the frame of its component. Raises LostPosesError."""
        folder = self._part[drive].folders[drive] if drive in self._part else ""
        if not folder:
            with reading_drive(drive):
                return tables.read_keyframes(self._store.run(drive) / "keyframes.parquet")
        fetch_poses(self._store, {drive: folder})
        try:
            return tables.read_keyframes(self._store.root / "joint" / folder / folder_name(drive) / "keyframes.parquet")
        except ResultError as error:
            raise LostPosesError(drive, str(error)) from None
