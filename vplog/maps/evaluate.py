"""The drives of a map against ground truth, those that are joined as one trajectory."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vplog.evaluation import evaluate_together
from vplog.maps.damage import left_out, without_damaged
from vplog.maps.joint_record import components_in
from vplog.maps.layout import folder_name
from vplog.maps.store import reading

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.evaluation import TruthOptions
    from vplog.maps.store import Store


def evaluate_map(root: Path, truth: str, options: TruthOptions) -> dict[str, Any]:
    """As `vplog.evaluation.evaluate` of a joint run; `truth` is in the clock of all drives. Raises VplogError."""
    with reading(root) as store:
        store.head()
        found = without_damaged(store, lambda: _evaluate(store, root, truth, options))
        return {**found, "warnings": left_out(store)}


def _evaluate(store: Store, root: Path, truth: str, options: TruthOptions) -> dict[str, Any]:
    folders = {drive: store.run(drive) for drive in store.drives()}
    for drive in folders:
        store.file(drive, "result.mcap")
    maps, joins = [], []
    for component in components_in(store) or []:
        place = f"joint/{component['folder']}"
        members = {drive: f"{place}/{folder_name(drive)}/trajectory.parquet" for drive in component["drives"]}
        if store.mirror is not None:
            store.mirror.rest([f"{place}/joins.parquet", *members.values()])
        maps.append({drive: store.root / name for drive, name in members.items()})
        joins.append(store.root / place / "joins.parquet")
    together = {drive for members in maps for drive in members}
    maps += [{drive: folder / "trajectory.parquet"} for drive, folder in folders.items() if drive not in together]
    return evaluate_together(root, folders, maps, joins, truth, options)
