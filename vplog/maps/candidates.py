"""Which drives of a map hold places like those of a new one."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from vplog.between import no_candidates, proposed_in, with_proposals
from vplog.errors import ResultError
from vplog.extract import map_in_order
from vplog.results import tables

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vplog.between import Candidates
    from vplog.loops.propose import Proposals
    from vplog.maps.members import Member
    from vplog.maps.store import Store
    from vplog.pipeline import Pipeline
    from vplog.stages import PlaceState

    Progress = Callable[[str, int, int], None]

_AT_ONCE = 64
"""New drives that are looked for while the places of one before them are in memory; theirs are too, some 40 MB."""


def places_of(store: Store, member: Member, state: PlaceState) -> Sequence[Any]:
    """The places of a drive. Raises ResultError where they are of another recogniser."""
    path = store.file(member.drive, "descriptors.parquet")
    column, _ = tables.read_descriptors(path)
    try:
        column = column.cast(state.arrow_type)  # the names of list items change in Parquet, nothing else may
    except pa.ArrowException:
        raise ResultError(f"{path} is of another recogniser. Remove the drive's folders.") from None
    return state.from_arrow(column)


def candidates_of(
    store: Store, members: Sequence[Member], new: Sequence[int], state: PlaceState, pipeline: Pipeline,
    threads: int = 1, progress: Progress = lambda *_: None,
) -> dict[int, Candidates]:  # fmt: skip
    """For each new drive, by number, its best candidates in all drives of a lower number.

    Each thread has a drive of its own to look through: of a drive's few hundred views, each is done too soon to share.
    """
    found = {number: no_candidates() for number in new}
    done, total = 0, sum(new)
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        for first in range(0, len(new), _AT_ONCE):
            block = {number: places_of(store, members[number], state) for number in new[first : first + _AT_ONCE]}

            def look_through(earlier: int, block: dict[int, Sequence[Any]] = block) -> list[tuple[int, Proposals]]:
                known = block.get(earlier) or places_of(store, members[earlier], state)
                those = [later for later in block if later > earlier]
                return [(later, proposed_in(block[later], known, state, pipeline)) for later in those]

            looked = map_in_order(pool, look_through, range(max(block)), ahead=2 * threads)
            for earlier, proposed in enumerate(looked):
                for later, more in proposed:
                    found[later] = with_proposals(found[later], earlier, more, pipeline)
                done += len(proposed)
                progress("search the map", done, total)
    return found
