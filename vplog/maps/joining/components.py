"""The joint graph of the drives of a map that closures join, and the folder of its results.

    MAP/joint.json                                     which of the folders below count; replaced as a whole
    MAP/joint/component=KEY/component.json             drives, what holds them together, what was learned of odometry
    MAP/joint/component=KEY/graph.g2o                  the graph, solved; keyframes drive after drive
    MAP/joint/component=KEY/joins.parquet              the ledger of all candidates between its drives, as judged
    MAP/joint/component=KEY/drive=ID/keyframes.parquet, trajectory.parquet
                                                       of each drive, in the frame of the component's first

KEY stands for all that the folder is made from, so one that a new drive does not touch stays as it is.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from vplog.data import Closures
from vplog.errors import NewerError, ResultError, VplogError
from vplog.execution.execution import Execution
from vplog.graph.build import parts
from vplog.loops.verify import no_closures
from vplog.maps.joining.drive_pairs import fetch_inputs
from vplog.maps.joining.growth import Growth, LostPosesError
from vplog.maps.joining.join_states import JoinState, PairState, write_states
from vplog.maps.joining.joint_graph import pair_record, read_drive, solution_record, solve_drives, write_component
from vplog.maps.joining.joint_record import count_between, is_whole, read_joint, write_joint
from vplog.maps.joining.members import Member
from vplog.maps.storage.damage import DamagedDriveError
from vplog.maps.storage.map_store import Store
from vplog.pipeline import Pipeline
from vplog.results import tables
from vplog.run.cache.code_hash import code_of
from vplog.storage.json_records import key_of


@dataclass(frozen=True)
class Drives:
    """The drives of a map that may be joined, in its order."""

    joins: list[JoinState]
    """The place of each in the order, and the drives that it was verified against."""
    records: dict[str, dict[str, Any]]
    """drive.json of these and others, by ID."""
    excluded: dict[str, str]
    """Why others are not joined, by ID."""
    library: str
    member: Callable[[int], Member]
    """A drive as verification needs it, by number. Raises ResultError."""
    others: list[JoinState]
    """States of drives that are excluded."""

    @cached_property
    def names(self) -> list[str]:
        """IDs in order."""
        return [one.drive for one in self.joins]

    @cached_property
    def number(self) -> dict[str, int]:
        """Place of each ID in the order."""
        return {drive: at for at, drive in enumerate(self.names)}

    def counts(self, later: int, pair: PairState) -> bool:
        """Whether a pair is valid: the drive that `later` was verified against is unchanged and comes before it."""
        at = self.number.get(pair["match"], later)
        return at < later and self.joins[at].member == pair["match_key"]

    def write(self, store: Store, changed: Collection[str]) -> None:
        """Write the states of these drives. Raises ResultError."""
        write_states(store, [*self.joins, *self.others], changed)


@dataclass(frozen=True)
class PairLedger:
    """A pair of drives with a ledger."""

    later: str
    earlier: str
    path: Path
    key: str
    """sha256 over all that the ledger depends on."""
    verified: int


@dataclass(frozen=True)
class Group:
    """Drives connected by verified closures, before the solve decides which of them it joins."""

    drives: tuple[str, ...]
    """IDs in the map's order."""
    pair_ledgers: tuple[PairLedger, ...]
    """Ledgers of all pairs of them, those of few closures too."""
    judged: dict[str, str]
    """sha256 over what the closures of each drive in earlier ones are decided by."""

    @property
    def key(self) -> str:
        """sha256 over all that the solve depends on."""
        return hashlib.sha256(json.dumps(self.judged).encode()).hexdigest()


def _settings(pipeline: Pipeline) -> dict[str, Any]:
    """Settings that the solve of a group depends on."""
    chosen = {name: getattr(pipeline, name).model_dump(mode="json") for name in ("solve", "refine")}
    return {**chosen, "join": pipeline.join.model_dump(mode="json", include={"least_closures", "spacing"})}


def groups_of(every: Drives, pair_ledgers: Sequence[PairLedger], pipeline: Pipeline) -> list[Group]:
    """The groups of two drives and more, in the order of their first ones."""
    order, at = every.names, every.number
    good = [entry for entry in pair_ledgers if entry.verified >= pipeline.join.least_closures]
    a, b = (np.array([at[getattr(one, end)] for one in good], np.int64) for end in ("earlier", "later"))
    number = parts(len(order), a, b)
    code = code_of("vplog.maps.joining.components", type(pipeline.solve).__module__)["code"]
    common, found = key_of([_settings(pipeline), code]), list[Group]()
    within: dict[int, list[PairLedger]] = {}
    for entry in pair_ledgers:
        if (one := int(number[at[entry.later]])) == number[at[entry.earlier]]:
            within.setdefault(one, []).append(entry)
    rows = np.split(np.argsort(number, kind="stable"), np.cumsum(np.bincount(number, minlength=1))[:-1])
    for one in np.flatnonzero(np.bincount(number, minlength=1) > 1).tolist():
        drives = tuple(order[row] for row in rows[one].tolist())
        own = tuple(sorted(within[one], key=lambda entry: (at[entry.later], at[entry.earlier])))
        met: dict[str, list[list[str]]] = {drive: [] for drive in drives}
        for entry in own:
            met[entry.later].append([entry.earlier, entry.key])
        made_from = {drive: json.dumps([common, every.records[drive]["key"], pairs]) for drive, pairs in met.items()}
        judged = {drive: hashlib.sha256(text.encode()).hexdigest()[:16] for drive, text in made_from.items()}
        found.append(Group(drives, own, judged))
    return found


def solve_group(store: Store, group: Group, pipeline: Pipeline, library: str, gone: dict[str, str]) -> dict[str, Any]:
    """Solve a group, and make the folder of each component that comes of it.

    Returns the group as joint.json has it: `components`, and the pairs kept `apart` with reasons. Drives whose ledgers
    are damaged are noted in `gone`. Raises GraphError where it cannot be solved, and ResultError where a drive's folder
    is damaged.
    """
    drives = [read_drive(drive, store.run(drive)) for drive in group.drives]
    at = {drive: number for number, drive in enumerate(group.drives)}
    fetch_inputs(store, [(entry.later, entry.earlier) for entry in group.pair_ledgers], ())
    ledgers = {(at[entry.later], at[entry.earlier]): _ledger(store, entry, gone) for entry in group.pair_ledgers}
    joined, ledgers = solve_drives(drives, ledgers, pipeline)
    header, components = tables.TableMetadata(_settings(pipeline), library), []
    for members, refined in joined.solved.items():
        names = [group.drives[member] for member in members]
        folder = f"component={key_of({'group': group.key, 'drives': names})[:16]}"
        inside = {pair: ledger for pair, ledger in ledgers.items() if set(pair) <= set(members)}
        named = {(group.drives[later], group.drives[earlier]): one for (later, earlier), one in inside.items()}
        components.append({"folder": folder, "drives": names, "between": count_between(named)})
        if is_whole(store, folder, names):  # of a join that was killed: it is the same
            continue
        rows = [(drives[later].keyframes, drives[earlier].keyframes, one) for (later, earlier), one in inside.items()]
        joins = [pair_record(*pair, one) for pair, one in named.items()]
        record = {**solution_record(names, joins, refined), "made_from": group.key}
        own = {name: drives[member] for name, member in zip(names, members, strict=True)}
        poses = {name: joined.world_from_body[member] for name, member in zip(names, members, strict=True)}
        write_component(store, folder, own, poses, rows, record, header, refined)
    pairs = {at: (pair.later, pair.earlier) for at, pair in enumerate(group.pair_ledgers)}
    apart = _apart_records({pairs[at]: reason for at, reason in sorted(joined.apart.items())})
    return {"key": group.key, "drives": list(group.drives), "components": components, "apart": apart}


def _apart_records(apart: Mapping[tuple[str, str], str]) -> list[dict[str, str]]:
    """The pairs of drives, later and earlier one, that their closures do not join, as joint.json has them."""
    return [{"query_drive": a, "match_drive": b, "reason": reason.strip()} for (a, b), reason in apart.items()]


def _ledger(store: Store, entry: PairLedger, gone: dict[str, str]) -> Closures:
    """The ledger; of a damaged one, which the next join makes again, no closures and a line in `gone`."""
    fetch_inputs(store, [(entry.later, entry.earlier)], ())
    try:
        if (ledger := tables.read_joins(entry.path).get((entry.later, entry.earlier))) is not None:
            return ledger
        why = f"{entry.path} is not of {entry.later} in {entry.earlier}."
    except ResultError as error:
        why = str(error)
    store.remove_beside(entry.path.relative_to(store.root).as_posix())
    gone[entry.later] = f"{why} It is left out, and made again by the next join."
    return no_closures()


def solve_groups(
    store: Store, drives: Drives, pair_ledgers: Sequence[PairLedger], pipeline: Pipeline, execution: Execution,
    *, whole: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Solve the groups that are not solved yet, write joint.json, and remove the folders of other groups. Drives are
    placed in groups of more than `join.judged_anew`; `whole`: which are then solved as a whole."""
    groups, before = groups_of(drives, pair_ledgers, pipeline), _joint(store)
    known = {group["key"]: group for group in before.get("groups", [])}
    few = len(drives.joins) <= pipeline.join.judged_anew
    solved, judged, gone = list[dict[str, Any]](), dict[str, str](), dict[str, str]()
    for done, group in enumerate(groups):
        execution.progress("solve together", done, len(groups))
        components, grown = known.get(group.key, {}).get("components"), len(group.drives) > pipeline.join.judged_anew
        there = components is not None and all(_is_there(store, one, few) for one in components)
        if there and not (grown and whole):
            record, keys = known[group.key], group.judged
        elif grown:
            record, keys = _grown(store, group, pipeline, drives.library, before, whole, gone)
        else:
            record = _solved(store, group, pipeline, drives.library, gone)
            keys = group.judged if record["key"] else {}
        judged |= keys
        solved.append(record)
    execution.progress("solve together", len(groups), len(groups))
    together = {drive for group in solved for component in group["components"] for drive in component["drives"]}
    alone = sorted([*(one for one in drives.names if one not in together), *drives.excluded])
    keys = {drive: drives.records[drive]["key"] for drive in sorted(together)}
    record = {"groups": solved, "alone": alone, "apart": drives.excluded, "keys": keys, "judged": judged}
    if solved or store.has_beside("joint.json"):
        write_joint(store.root, record)
    named = {name for group in solved for component in group["components"] for name in folders_of(component)}
    for name in store.names_beside("joint") - named:
        store.remove_beside(f"joint/{name}")
    if gone:
        for at in [drives.number[drive] for drive in gone]:
            drives.joins[at] = replace(drives.joins[at], made_from="")
        drives.write(store, gone.keys())
    return record


def _joint(store: Store) -> dict[str, Any]:
    try:
        return read_joint(store.root)
    except NewerError:
        raise
    except VplogError:  # damaged: it is written again
        return {}


def _grown(
    store: Store, group: Group, pipeline: Pipeline, library: str, before: Mapping[str, Any], whole: bool,
    gone: dict[str, str],
) -> tuple[dict[str, Any], dict[str, str]]:  # fmt: skip
    """The group as joint.json has it, its new drives placed in the components `before`, and the keys of those that are
    not tried again."""
    header, judged = tables.TableMetadata(_settings(pipeline), library), group.judged
    damaged = dict[str, str]()
    entries = [one for one in group.pair_ledgers if one.verified]
    pairs = {(one.later, one.earlier): partial(_ledger, store, one, damaged) for one in entries}
    inside, known = set(group.drives), [one for other in before.get("groups", []) for one in other["components"]]
    known = [one for one in known if inside & set(one["drives"]) and _is_there(store, one)]
    stayed, lost = before.get("judged", {}), set[str]()
    if not known or all(stayed.get(one) != judged[one] for one in group.drives):
        seed = _first_of(group, pipeline)
        known = _solved(store, seed, pipeline, library, damaged)["components"]
        stayed = {one: judged[one] for one in seed.drives}
    while True:
        stays = [one for one in group.drives if stayed.get(one) == judged[one] and one not in lost]
        try:
            growth = Growth(store, pipeline, header, judged, known, stays, pairs)
            there = set(stays)
            growth.add([one for one in group.drives if one not in there])
            if whole:
                growth.solve_all()
            break
        except LostPosesError as error:
            lost.add(error.drive)
    key = "" if growth.failed or damaged else group.key  # tried again
    record = {"key": key, "drives": list(group.drives), "components": growth.records()}
    record["apart"] = _apart_records(growth.apart)
    if growth.reasons or damaged:
        record["reason"] = " ".join([*growth.reasons, *damaged.values()])
    gone |= damaged
    return record, {drive: key for drive, key in judged.items() if drive not in growth.failed}


def _first_of(group: Group, pipeline: Pipeline) -> Group:
    """The drives of a group that are nearest to its first one by closures, as many as are judged together."""
    near: dict[str, list[str]] = {drive: [] for drive in group.drives}
    for one in group.pair_ledgers:
        if one.verified >= pipeline.join.least_closures:
            near[one.later].append(one.earlier)
            near[one.earlier].append(one.later)
    found = [group.drives[0]]
    for drive in found:
        found += [one for one in dict.fromkeys(near[drive]) if one not in found]
        if len(found) >= pipeline.join.judged_anew:
            break
    chosen = set(found[: pipeline.join.judged_anew])
    ledgers = tuple(one for one in group.pair_ledgers if {one.later, one.earlier} <= chosen)
    drives = tuple(one for one in group.drives if one in chosen)
    return Group(drives, ledgers, {one: group.judged[one] for one in drives})


def folders_of(component: Mapping[str, Any]) -> set[str]:
    """Folders in MAP/joint that a component is in."""
    return {component["folder"], *component.get("grown", {}).values()}


def _is_there(store: Store, component: Mapping[str, Any], checked: bool = False) -> bool:
    """Whether the folders of a component are there and, if `checked`, as they were written."""
    if checked:
        return is_whole(store, component["folder"], component["drives"])
    return all(store.has_beside(f"joint/{one}/component.json") for one in folders_of(component))


def _solved(store: Store, group: Group, pipeline: Pipeline, library: str, gone: dict[str, str]) -> dict[str, Any]:
    try:
        record = solve_group(store, group, pipeline, library, gone)
    except DamagedDriveError:  # the others are solved without it
        raise
    except VplogError as error:  # one group must not take the others along; it is tried again
        return {"key": "", "drives": list(group.drives), "components": [], "apart": [], "reason": str(error)}
    if damaged := [gone[drive] for drive in group.drives if drive in gone]:
        record |= {"key": "", "reason": " ".join(damaged)}
    return record
