"""The joint graph of the drives of a map that closures join, and the folder that keeps what came of it.

    MAP/joint.json                                     which of the folders below count; replaced as a whole
    MAP/joint/component=KEY/component.json             drives, what holds them together, what was learned of odometry
    MAP/joint/component=KEY/graph.g2o                  the graph, solved; keyframes drive after drive
    MAP/joint/component=KEY/joins.parquet              the ledger of all candidates between its drives, as judged
    MAP/joint/component=KEY/drive=ID/keyframes.parquet, trajectory.parquet
                                                       of each drive, in the frame of the component's first

KEY stands for all that the folder is made from, so one that a new drive does not touch stays as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.code_hash import code_of
from vplog.errors import ResultError
from vplog.graph import joint as graph_joint
from vplog.graph.build import parts
from vplog.graph.correct import correct_trajectory
from vplog.joint_graph import between_of, judged_by, own_drive
from vplog.maps.damage import reading_drive
from vplog.maps.keys import key_of
from vplog.results import g2o, run_record, tables

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from vplog.data import Closures, Keyframes
    from vplog.graph.refine import Refined, RefineSettings
    from vplog.graph.solve import OptimiserSettings


@dataclass(frozen=True)
class Tie:
    """What joins two drives."""

    later: str
    earlier: str
    path: Path
    """Table of the ledger."""
    key: str
    """Of all that the ledger depends on."""
    verified: int


@dataclass(frozen=True)
class Group:
    """Drives that verified closures join, if the solve does not think otherwise."""

    drives: tuple[str, ...]
    """In the map's order."""
    ties: tuple[Tie, ...]
    """All between them, those of few closures too."""
    key: str
    """sha256 over all that the solve depends on."""


@dataclass(frozen=True)
class Solving:
    """How groups are solved."""

    solve: OptimiserSettings
    join: graph_joint.JoinSettings
    refine: RefineSettings
    library: str

    @property
    def settings(self) -> dict[str, Any]:
        chosen = {name: getattr(self, name).model_dump(mode="json") for name in ("solve", "refine")}
        return {**chosen, "join": self.join.model_dump(mode="json", include={"least_closures", "spacing"})}


def groups_of(order: Sequence[str], keys: dict[str, str], ties: Sequence[Tie], solving: Solving) -> list[Group]:
    """The groups of two drives and more, in the order of their first ones. `keys` are those of drive.json."""
    at = {drive: number for number, drive in enumerate(order)}
    good = [tie for tie in ties if tie.verified >= solving.join.least_closures]
    number = parts(
        len(order), np.array([at[t.earlier] for t in good], np.int64), np.array([at[t.later] for t in good], np.int64)
    )
    code = code_of("vplog.maps.components", type(solving.solve).__module__)["code"]
    found = []
    for one, count in enumerate(np.bincount(number, minlength=1)):
        if count < 2:
            continue
        drives = tuple(order[row] for row in np.flatnonzero(number == one).tolist())
        inside = set(drives)
        own = tuple(
            sorted(
                (tie for tie in ties if tie.later in inside and tie.earlier in inside),
                key=lambda tie: (at[tie.later], at[tie.earlier]),
            )
        )
        made_from = {
            "drives": [[drive, keys[drive]] for drive in drives],
            "ledgers": [[tie.later, tie.earlier, tie.key] for tie in own],
            "settings": solving.settings,
            "code": code,
        }
        found.append(Group(drives, own, key_of(made_from)))
    return found


def solve_group(group: Group, runs: dict[str, Path], solving: Solving, staging: Path) -> dict[str, Any]:
    """Solve a group, and make a folder in `staging` for each component that comes of it.

    What joint.json says of the group: its `components`, and which pairs are kept `apart`, and why. Raises GraphError
    where it cannot be solved, and ResultError where a drive's folder is damaged.
    """
    loaded = []
    for drive in group.drives:
        with reading_drive(drive):
            loaded.append(_drive(runs[drive]))
    at = {drive: number for number, drive in enumerate(group.drives)}
    ledgers = [_ledger(tie) for tie in group.ties]
    between = [
        between_of(at[tie.later], at[tie.earlier], ledger) for tie, ledger in zip(group.ties, ledgers, strict=True)
    ]
    told: dict[str, Any] = {"key": group.key, "drives": list(group.drives), "components": [], "apart": []}
    own = [drive for _, drive in loaded]
    joined = graph_joint.join(own, between, solving.solve, solving.join, solving.refine)
    judged = [judged_by(*found) for found in zip(ledgers, joined.weight, joined.residual, strict=True)]
    told["apart"] = [
        {"query_drive": group.ties[pair].later, "match_drive": group.ties[pair].earlier, "reason": reason.strip()}
        for pair, reason in sorted(joined.apart.items())
    ]
    for members in joined.maps:
        if members in joined.solved:
            drives = [group.drives[member] for member in members]
            folder = f"component={key_of({'group': group.key, 'drives': drives})[:16]}"
            held = [pair for pair, one in enumerate(between) if one.later in members and one.earlier in members]
            about = _told(group, drives, [(group.ties[pair], judged[pair]) for pair in held], joined.solved[members])
            keyframes = [loaded[member][0] for member in members]
            _write(staging / folder, about, joined, members, keyframes, runs, solving)
            tables.write_joins(
                staging / folder / "joins.parquet",
                [(loaded[between[p].later][0], loaded[between[p].earlier][0], judged[p]) for p in held],
                tables.TableMetadata(solving.settings, solving.library),
            )
            run_record.write_run_json(staging / folder / "component.json", about)  # last: the folder is whole
            told["components"].append({"folder": folder, "drives": drives})
    return told


def _drive(run: Path) -> tuple[Keyframes, graph_joint.Drive]:
    """A drive as its run folder has it. Raises ResultError."""
    keyframes, poses = tables.read_keyframes(run / "keyframes.parquet")
    graph, weight, _ = tables.read_edges(run / "edges.parquet", poses)
    odometry = run_record.read_run_json(run / "run.json").get("odometry")
    factor = odometry.get("sigma_factor") if isinstance(odometry, dict) else None
    if not isinstance(factor, int | float) or not factor > 0:
        raise ResultError(f"{run}/run.json lacks odometry.sigma_factor. Run `vplog batch` with the drive's log again.")
    return keyframes, own_drive(graph, weight, tables.read_closures(run / "closures.parquet"), float(factor))


def _ledger(tie: Tie) -> Closures:
    ledger = tables.read_joins(tie.path).get((tie.later, tie.earlier))
    if ledger is None:
        raise ResultError(f"{tie.path} is not of {tie.later} in {tie.earlier}. Move it out of the map, and run again.")
    return ledger


def _write(
    folder: Path, about: dict[str, Any], joined: graph_joint.Joined, members: tuple[int, ...],
    keyframes: Sequence[Keyframes], runs: dict[str, Path], solving: Solving,
) -> None:  # fmt: skip
    """The graph of a component, and where each of its drives is in it."""
    header = tables.TableMetadata(solving.settings, solving.library)
    refined = joined.solved[members]
    folder.mkdir(parents=True, exist_ok=True)
    g2o.write_g2o(folder / "graph.g2o", refined.graph, refined.solution.world_from_body)
    for drive, own, member in zip(about["drives"], keyframes, members, strict=True):
        place = folder / runs[drive].name
        place.mkdir(exist_ok=True)
        poses = joined.world_from_body[member]
        with reading_drive(drive):
            _, odometry = tables.read_trajectory(runs[drive] / "trajectory.parquet")
        tables.write_keyframes(place / "keyframes.parquet", own, poses, header)
        tables.write_trajectory(
            place / "trajectory.parquet", correct_trajectory(odometry, own, poses), odometry, header
        )  # fmt: skip


def _told(group: Group, drives: list[str], pairs: Sequence[tuple[Tie, Closures]], refined: Refined) -> dict[str, Any]:
    """component.json."""
    joins = []
    for tie, ledger in pairs:
        kept = int(np.nansum(ledger.weight))
        joins.append({
            "query_drive": tie.later,
            "match_drive": tie.earlier,
            "candidates": len(ledger),
            "verified": int(np.isfinite(ledger.weight).sum()),
            "kept": kept,
            "median_residual_sigma": float(np.nanmedian(ledger.residual_after)) if kept else None,
        })  # fmt: skip
    solution = refined.solution
    return {
        "drives": drives,
        "joins": joins,
        "solution": {
            "error_before": solution.error_before,
            "error_after": solution.error_after,
            "iterations": solution.iterations,
            "converged": solution.converged,
            "reason": solution.reason,
        },
        "odometry": {"sigma_factor": float(np.sqrt(refined.noise)), "scale": refined.scale},
        "made_from": group.key,
    }
