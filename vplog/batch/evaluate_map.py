"""The drives of a map against their ground truth: a table of them, and means by tag and by version of vplog."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from vplog.batch.drive_inputs import MANIFESTS, manifest
from vplog.batch.plan import absolute_log
from vplog.errors import TruthError, VplogError
from vplog.maps.storage import map_store
from vplog.results import run_record
from vplog.run.provenance import UNNAMED, stored_log
from vplog.storage.remote_path import is_elsewhere, located
from vplog.storage.urls import shown
from vplog.verbs.evaluate_run import TruthOptions, evaluate, figures_of

_MEANS = ("ate_m", "recall")
"""Figures of which groups have the mean."""
_AGAIN = "Give a truth file in a manifest: --truth FILE.csv. Or evaluate the drive by itself, with --log LOG."


def evaluate_map(root: Path, truth: str = "auto", options: TruthOptions | None = None) -> dict[str, Any]:
    """Figures of every drive of a map against its truth and what bears on them, as `evaluate` has it, or `error`, why
    there are none; and of groups of drives.

    `truth` is a manifest with a column `truth`; a TUM file of all drives; `gps`; or `auto`: of each drive the truth
    that its manifest named when it was computed, else the one that comes with its log. Raises VplogError.
    """
    named = _named_truths(located(truth)) if located(truth).suffix.lower() in MANIFESTS else None
    with map_store.reading(root) as store:
        known, nothing = store.drives(), {"tags": {}, "vplog": None, "truth": "", **figures_of({})}
        drives = [{"drive": drive, **nothing, "error": why} for drive, why in sorted(store.damaged.items())]
        for drive, about in known.items():
            own = truth if named is None else named.get(about["log"]) or named.get(drive) or ""
            is_recorded = own == "auto" and "truth" in about
            own = str(about["truth"]) if is_recorded else own
            row = {"drive": drive, "tags": about.get("tags", {}), "vplog": None, "truth": shown(own)}
            try:
                folder = store.run(drive, [*map_store.RUN_TABLES, "result.mcap"])
                record = run_record.read_run_json(folder / "run.json")
                row["vplog"] = record.get("vplog")
                if not own:
                    raise TruthError(f"{truth} names no truth of it.")
                if is_recorded and is_elsewhere(own, str(root)):
                    raise TruthError(f"Its truth {shown(own)} {UNNAMED}. Give it in a manifest: --truth FILE.csv")
                log = None
                if own in ("gps", "auto"):
                    log = stored_log(about["log"], str(root), "The log of the run", _AGAIN)
                found = evaluate(folder, own, None, options, log)
            except VplogError as error:
                found = {"error": str(error)}
            noted = {name: found.get(name) for name in ("truth_is", "interpolated", "warnings")}
            drives.append({**row, **figures_of(found), **noted, "error": found.get("error", "")})
            store.evict(drive)
    if all(one["error"] for one in drives):
        why = f" Of {drives[0]['drive']}: {drives[0]['error']}" if drives else ""
        raise TruthError(f"No drive of {root} can be evaluated.{why}")
    return {"map": str(root), "drives": drives, "groups": _groups(drives)}


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
