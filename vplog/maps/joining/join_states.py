"""States of the drives of a map in its joins: after which drives each came, and which of them it was verified against.

    MAP/joins/states-00000.json.gz     of the drives at positions 0 to 511, and so on

So a join reads one file for hundreds of drives, and new drives touch the last one alone.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator, TypeAdapter
from typing_extensions import TypedDict  # as pydantic needs it below Python 3.12

from vplog.errors import ResultError
from vplog.storage.compressed_json import read_compressed, write_compressed

if TYPE_CHECKING:
    from vplog.maps.storage.map_store import Store

STATES = "states-"
_OF_EACH = 512
"""Positions of a file: with 30 pairs a drive it has some 5 MB, a tenth of that compressed."""
_Text = Annotated[str, AfterValidator(sys.intern)]
"""A text that many states have, in memory once."""


class PairState(TypedDict):
    """A drive that another one was verified against."""

    match: _Text
    match_key: _Text
    """`Member.key` of that drive."""
    candidates: int
    verified: int
    """Candidates that geometry confirmed."""
    ledger: str
    """Key of the ledger; empty where the pair was left out."""


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
    made_from: _Text = ""
    """sha256 over what the pairs depend on, beside the drives before it; empty as long as they are not all there."""
    pairs: tuple[PairState, ...] = ()

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


_STATES = TypeAdapter(list[JoinState])


def read_states(store: Store) -> dict[str, JoinState]:
    """The states that are known of drives, also of some that are gone; of a damaged file none."""
    files = sorted(f"joins/{name}" for name in store.names_beside("joins") if name.startswith(STATES))
    store.fetch_beside(files)
    found = dict[str, JoinState]()
    for name in files:
        with suppress(ResultError, ValueError):
            states = _STATES.validate_python(read_compressed(store.root / name))
            found |= {state.drive: state for state in states}
    return found


def write_states(
    store: Store, states: Iterable[JoinState], changed: Collection[str], gone: Iterable[JoinState] = ()
) -> None:
    """Write the files in which the states of these drives are, and without those of drives that are `gone`: one that
    comes back is a new one. Raises ResultError."""
    without = {one.position // _OF_EACH for one in gone}
    files: dict[int, list[JoinState]] = {number: [] for number in sorted(without)}
    for one in states:
        files.setdefault(one.position // _OF_EACH, []).append(one)
    for number, inside in files.items():
        if number in without or any(one.drive in changed for one in inside):
            rows = [asdict(one) for one in sorted(inside, key=lambda one: (one.position, one.drive))]
            write_compressed(store.root / "joins" / f"{STATES}{number:05d}.json.gz", rows)
