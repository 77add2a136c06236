"""States of the drives of a map in its joins: after which drives each came, and which of them it was verified against.

    MAP/joins/states-00000.json.gz     of the drives at positions 0 to 511, and so on

So a join reads one file for hundreds of drives, and new drives touch the last one alone.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from vplog.errors import ResultError
from vplog.storage.compressed_json import read_compressed, write_compressed

if TYPE_CHECKING:
    from vplog.maps.storage.map_store import Store

STATES = "states-"
_OF_EACH = 512
"""Positions of a file: with 30 pairs a drive it has some 5 MB, a tenth of that compressed."""
_PAIR = {"match": str, "match_key": str, "candidates": int, "verified": int, "ledger": str}


@dataclass(frozen=True)
class JoinState:
    """After which drives one came, and which of them it was verified against."""

    drive: str
    position: int
    """Increases from drive to drive: by ID within a batch. It stays while the drive stays what it is."""
    member: str
    """`Member.key` of the drive that has it."""
    key: str = ""
    """Key of that in its drive.json; empty where it is not known."""
    gps: bool = False
    """Whether it was solved with GPS factors."""
    made_from: str = ""
    """sha256 over what the pairs depend on, beside the drives before it; empty as long as they are not all there."""
    pairs: tuple[dict[str, Any], ...] = ()
    """`match`, `match_key` (the drive's), `candidates`, `verified`, and `ledger`, its key, empty where it is
    left out; `reason` then says why."""

    def why_apart(self, library: str, made_by: str) -> str:
        """Why it is joined with no other, by the libraries of the map and of the drive; empty where it may be."""
        if made_by != library:
            return (
                f"{self.drive} was described with library {made_by[:12]}, and the map's is {library[:12]}: it is "
                "joined with no other drive."
            )
        if self.gps:
            return (
                f"{self.drive} was solved with GPS factors, which are for one drive at a time: it keeps its own "
                "georeference and is joined with no other drive."
            )
        return ""


def read_states(store: Store, drives: Collection[str]) -> dict[str, JoinState]:
    """The states that are known of these drives; of a damaged file none."""
    files = sorted(f"joins/{name}" for name in store.names_beside("joins") if name.startswith(STATES))
    store.fetch_beside(files)
    found, text = dict[str, JoinState](), dict[str, str]()
    for name in files:
        try:
            rows = read_compressed(store.root / name)
        except ResultError:
            continue
        for row in rows if isinstance(rows, list) else ():
            if (state := _state(row, text)) is not None and state.drive in drives:
                found[state.drive] = state
    return found


def write_states(store: Store, states: Iterable[JoinState], changed: Collection[str]) -> None:
    """Write the files in which the states of these drives are. Raises ResultError."""
    files: dict[int, list[JoinState]] = {}
    for one in states:
        files.setdefault(one.position // _OF_EACH, []).append(one)
    for number, inside in files.items():
        if any(one.drive in changed for one in inside):
            rows = [asdict(one) for one in sorted(inside, key=lambda one: (one.position, one.drive))]
            write_compressed(store.root / "joins" / f"{STATES}{number:05d}.json.gz", rows)


def _state(row: Any, text: dict[str, str]) -> JoinState | None:
    """A state by its record, equal texts as one; None where it is none, without pairs where these are damaged."""
    try:
        own = JoinState(row["drive"], row["position"], row["member"], row.get("key", ""), row.get("gps", False))
        made_from, pairs = row["made_from"], row["pairs"]
    except (KeyError, TypeError, AttributeError):
        return None
    kinds = {"drive": str, "position": int, "member": str, "key": str, "gps": bool}
    if any(not isinstance(getattr(own, name), kind) for name, kind in kinds.items()) or not isinstance(made_from, str):
        return None
    if not isinstance(pairs, list) or any(
        not isinstance(pair, dict) or any(not isinstance(pair.get(name), kind) for name, kind in _PAIR.items())
        for pair in pairs
    ):
        return own
    for pair in pairs:
        pair |= {name: text.setdefault(pair[name], pair[name]) for name in ("match", "match_key")}
    return replace(own, made_from=text.setdefault(made_from, made_from), pairs=tuple(pairs))
