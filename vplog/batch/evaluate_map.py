"""The drives of a map against their ground truth: a table of them, and means by tag and by version of vplog."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from vplog.batch.drive_inputs import MANIFESTS, manifest
from vplog.batch.plan import absolute_log
from vplog.errors import TruthError, VplogError
from vplog.evaluate.trajectory import ate_together
from vplog.maps.joining.joint_record import (
    Component,
    between_by_drive,
    components_in,
    joint_components,
    joint_folder,
    joint_ledgers,
)
from vplog.maps.storage import map_store
from vplog.maps.storage.map_store import Store
from vplog.results import run_record
from vplog.run.provenance import UNNAMED, stored_log
from vplog.storage.remote_path import is_elsewhere, located
from vplog.storage.urls import shown
from vplog.verbs.evaluate_run import SharedTruth, TruthOptions, evaluate_drive, figures_of, judge_joins

_OTHER_TRUTH = (
    "This drive is joined with drives that have another truth, so its ATE does not contain the error of its place "
    "among them. Give one truth file for all of them."
)
_MEANS = ("ate_m", "recall")
"""Figures of which groups have the mean."""
_AGAIN = "Give a truth file in a manifest: --truth FILE.csv. Or evaluate the drive by itself, with --log LOG."


def evaluate_map(root: Path, truth: str = "auto", options: TruthOptions | None = None) -> dict[str, Any]:
    """Compare every drive of a map with its truth. Return the figures of `drives`, of `groups` and of `components`. A
    drive that cannot be compared has the reason as its `error`.

    A joined drive is compared by its poses in the joint graph. Drives of one joint graph whose truths share a frame
    (one TUM file, or satellite fixes) are a component. They are aligned together, so `ate_m` of each contains the error
    of its place among the others, and the closures between them are judged (`joins`). `between` counts the accepted
    closures of a drive with other drives, and `false_between` the false ones.

    `truth` is a manifest with a column `truth`; a TUM file of all drives; `gps`; or `auto`: of each drive the truth
    that its manifest named when it was computed, else the one that comes with its log. Raises VplogError.
    """
    named = _named_truths(located(truth)) if located(truth).suffix.lower() in MANIFESTS else None
    with map_store.reading(root) as store:
        options = options or TruthOptions()
        known, joint = store.drives(), joint_components(store)
        between = between_by_drive(components_in(store) or [], known)
        nothing: dict[str, Any] = {"tags": {}, "vplog": None, "truth": "", **figures_of({})}
        nothing |= {"between": None, "false_between": None}
        truths = dict[str, SharedTruth]()
        drives = [{"drive": drive, **nothing, "error": why} for drive, why in sorted(store.damaged.items())]
        for drive, about in known.items():
            own = truth if named is None else named.get(about["log"]) or named.get(drive) or ""
            is_recorded = own == "auto" and "truth" in about
            own = str(about["truth"]) if is_recorded else own
            row = {"drive": drive, **nothing, "tags": about.get("tags", {}), "truth": shown(own)}
            row["between"] = between[drive]
            try:
                folder = store.run(drive, [*map_store.RUN_TABLES, "result.mcap"])
                record = run_record.read_finished_run(folder)
                row["vplog"] = record.get("vplog")
                if not own:
                    raise TruthError(f"{truth} names no truth of it.")
                if is_recorded and is_elsewhere(own, str(root)):
                    raise TruthError(f"Its truth {shown(own)} {UNNAMED}. Give it in a manifest: --truth FILE.csv")
                log = None
                if own in ("gps", "auto"):
                    log = stored_log(about["log"], str(root), "The log of the run", _AGAIN)
                placed = joint_folder(store, joint, drive)
                found, truths[drive] = evaluate_drive(folder, record, own, None, options, log, placed)
            except VplogError as error:
                found = {"error": str(error)}
            noted = {name: found.get(name) for name in ("truth_is", "interpolated", "warnings")}
            drives.append({**row, **figures_of(found), **noted, "error": found.get("error", "")})
            store.evict(drive)
        rows = {str(one["drive"]): one for one in drives}
        components = _components(store, joint, truths, rows, options)
    if all(one["error"] for one in drives):
        why = f" Of {drives[0]['drive']}: {drives[0]['error']}" if drives else ""
        raise TruthError(f"No drive of {root} can be evaluated.{why}")
    return {"map": str(root), "drives": drives, "groups": _groups(drives), "components": components}


def _components(
    store: Store, joint: Mapping[str, Component], truths: Mapping[str, SharedTruth], rows: dict[str, dict[str, Any]],
    options: TruthOptions,
) -> list[dict[str, Any]]:  # fmt: skip
    """Align the drives of each component together and judge the closures between them. The rows of these drives get the
    ATE of the common alignment and their false closures."""
    found = []
    for names in dict.fromkeys(tuple(one.drives) for one in joint.values()):
        shared: dict[str, dict[str, SharedTruth]] = {}
        for drive in names:
            if drive in truths:
                shared.setdefault(truths[drive].frame or f"of {drive}", {})[drive] = truths[drive]
        ledgers = joint_ledgers(store, {joint[drive].folder.name for drive in names}) if shared else {}
        for drives in shared.values():
            if len(shared) > 1:
                for drive in drives:
                    rows[drive]["warnings"].append(_OTHER_TRUTH)
            if len(drives) < 2:
                continue
            whole, *each = ate_together([one.matched for one in drives.values()], options.align or "se3")
            joins, false = judge_joins(ledgers, drives, options), Counter[str]()
            for pair in joins:
                false.update(dict.fromkeys((pair["query_drive"], pair["match_drive"]), pair["accepted_false"]))
            for drive, ate in zip(drives, each, strict=True):
                rows[drive] |= {"ate_m": ate.rmse_m, "false_between": false[drive] if joins else None}
            truth = rows[next(iter(drives))]["truth"]
            found.append({"drives": list(drives), "truth": truth, "ate_after": asdict(whole), "joins": joins})
    return found


def _named_truths(path: Path) -> dict[str, str]:
    """Truth of the drives of a manifest, by name and by log."""
    rows = [(one, str(one.about["truth"])) for one in manifest(path) if "truth" in one.about]
    return {key: truth for one, truth in rows for key in (one.name, shown(absolute_log(one.log))) if key}


def _groups(drives: Iterable[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Number, means and false closures of all drives that have figures, and of those with one tag or version."""
    groups: dict[str, list[dict[str, Any]]] = {"all": []}
    for one in drives:
        if not one["error"]:
            for name in ("all", *(f"{tag}={text}" for tag, text in one["tags"].items()), f"vplog {one['vplog']}"):
                groups.setdefault(name, []).append(one)
    return {name: _means(groups[name]) for name in ("all", *sorted(groups.keys() - {"all"}))}


def _means(drives: list[dict[str, Any]]) -> dict[str, Any]:
    known = {name: [one[name] for one in drives if one[name] is not None] for name in (*_MEANS, "false_closures")}
    means = {name: sum(known[name]) / len(known[name]) if known[name] else None for name in _MEANS}
    return {
        "drives": len(drives),
        **means,
        "false_closures": sum(known["false_closures"]) if known["false_closures"] else None,
    }
