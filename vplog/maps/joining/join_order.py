"""The drives of a map in the order in which they are joined, and the pairs that have ledgers."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vplog.errors import VplogError
from vplog.maps.joining import drive_pairs
from vplog.maps.joining.components import Tie
from vplog.maps.joining.members import apart, member_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from vplog.maps.joining.drive_pairs import Joins
    from vplog.maps.joining.members import Member
    from vplog.maps.storage.map_store import Store
    from vplog.pipeline import Pipeline


@dataclass(frozen=True)
class Drives:
    """The drives of a map that may be joined, in its order."""

    members: list[Member]
    joins: list[Joins]
    """The place of each in the order, and the drives that it was verified against."""
    keys: dict[str, str]
    """Keys of drive.json, by ID."""
    apart: dict[str, str]
    """Why others are not joined, by ID."""
    library: str
    number: dict[str, int]
    """Place of each member in the order, by ID."""

    def counts(self, later: int, pair: dict[str, Any]) -> bool:
        """Whether the drive that a pair is with is there, before its own, and the one that it was then."""
        at = self.number.get(pair["match"], later)
        return at < later and self.members[at].key == pair["match_key"]


def read_drives(store: Store, urls: Mapping[str, str]) -> Drives:
    """Give new drives their place in the order. What is given stays, so a killed join goes on as it began."""
    library = store.head().library or ""
    members, reasons, known = [], {}, store.drives()
    for drive, about in known.items():
        try:
            member = member_of(store, {**about, "log": urls.get(drive, about["log"])})
        except VplogError as error:
            reasons[drive] = f"{drive} is joined with no other drive. {error}"
            continue
        if why := apart(member, library, about["library"]):
            reasons[drive] = why
        else:
            members.append(member)
    joins = {member.drive: drive_pairs.read_joins(store, member.drive) for member in members}
    last = max((one.position for one in joins.values() if one is not None), default=-1)
    placed: list[tuple[int, str, Member, Joins]] = []
    for member in members:
        own = joins[member.drive]
        if own is None or own.member != member.key:
            last += 1
            own = drive_pairs.Joins(last, member.key)
            drive_pairs.put_joins(store, member.drive, own)
        placed.append((own.position, member.drive, member, own))
    placed.sort(key=lambda one: one[:2])
    keys = {drive: about["key"] for drive, about in known.items()}
    number = {one[1]: at for at, one in enumerate(placed)}
    return Drives([one[2] for one in placed], [one[3] for one in placed], keys, reasons, library, number)


def is_up_to_date(store: Store, drives: Drives, at: int, pipeline: Pipeline) -> bool:
    """Whether a drive need not be searched again: a drive that is gone has taken candidates that others might have."""
    member, joins = drives.members[at], drives.joins[at]
    return joins.made_from == drive_pairs.search_key(member, pipeline) and all(
        drives.counts(at, pair)
        and pair["ledger"]
        and drive_pairs.ledger_path(store, member.drive, pair["match"]).is_file()
        for pair in joins.pairs
    )


def settled_ties(store: Store, drives: Drives) -> list[Tie]:
    """The pairs that count; what there is between others, as drives that are gone, is removed."""
    ties = []
    for at, (member, joins) in enumerate(zip(drives.members, drives.joins, strict=True)):
        held = [pair for pair in joins.pairs if pair["ledger"] and drives.counts(at, pair)]
        drive_pairs.forget(store, member.drive, {pair["match"] for pair in held})
        ties += [
            Tie(
                member.drive,
                pair["match"],
                drive_pairs.ledger_path(store, member.drive, pair["match"]),
                pair["ledger"],
                pair["verified"],
            )
            for pair in held
            if pair["candidates"]
        ]
    for folder in store.root.glob("joins/drive=*"):
        if not (store.root / "runs" / folder.name).is_dir():
            shutil.rmtree(folder, ignore_errors=True)
    return ties
