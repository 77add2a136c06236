"""Results on a terminal: text, tables, and JSON for programs."""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import sys
import textwrap
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

from vplog.errors import plural
from vplog.storage.urls import printable, without_secrets

_NAMED = 3
"""Drives that are named."""
_UNMOVED_M = 1e-3
"""m: less is what rounding and the solver's last digits come to."""


def print_status(message: str) -> None:
    """A line on stderr, wrapped as those of results; a closed or full stderr is ignored."""
    with suppress(OSError):
        text = printable(without_secrets(message))
        print(_wrapped(f"vplog: {text}", terminal_width(sys.stderr)), file=sys.stderr)


def print_traceback(
    words: Sequence[str], _: type[BaseException], error: BaseException, __: TracebackType | None
) -> None:
    """A traceback on stderr, which may name URLs as any other text, and those of the words of a command."""
    print(without_secrets("".join(traceback.format_exception(error)), words), end="", file=sys.stderr)


def warn(warnings: Iterable[str]) -> None:
    for warning in warnings:
        print_status(f"warning: {warning}")


def terminal_width(stream: TextIO) -> int | None:
    """Columns of the terminal that a stream is; None for a pipe or a file, where a line has no limit."""
    with suppress(OSError, ValueError):  # it is no file
        return os.get_terminal_size(stream.fileno()).columns or None
    return None


def print_line(label: str, text: str) -> None:
    """A label and a text, wrapped between words where stdout is a terminal: names are whole and can be copied."""
    line = printable(f"{label:10}{' ' if len(label) > 9 else ''}{text}")
    print(_wrapped(line, terminal_width(sys.stdout)))


def _wrapped(line: str, width: int | None) -> str:
    if width is None:
        return line
    return textwrap.fill(
        line, max(width, 20), subsequent_indent=" " * min(10, width // 4), break_long_words=False,
        break_on_hyphens=False,
    )  # fmt: skip


def print_table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Aligned columns, numbers to the right; a block for each row where the terminal is too narrow for them.

    A title may have several lines. No cell is ever shortened, and no name broken.
    """
    from rich.cells import cell_len

    cells = [[*map(printable, row)] for row in rows]
    heads = [list(line) for line in zip_longest(*(title.split("\n") for title in titles), fillvalue="")]
    widths = [max(map(cell_len, column)) for column in zip(*heads, *cells, strict=True)]
    right = [all(re.fullmatch(r"[-+.\d]*", cell) for cell in column) for column in zip(*cells, strict=True)]
    width = terminal_width(sys.stdout)
    if width is None or sum(widths) + 2 * len(widths) <= width:
        for row in heads + cells:
            blanks = [" " * (wide - cell_len(cell)) for wide, cell in zip(widths, row, strict=True)]
            texts = (
                blank + cell if number else cell + blank
                for blank, cell, number in zip(blanks, row, right or [False] * len(row), strict=True)
            )
            print("  ".join(texts).rstrip())
        return
    for first, *others in cells:
        print(first)
        named = zip(titles[1:], others, strict=True)
        print_line("", ", ".join(f"{' '.join(title.split())} {cell}" for title, cell in named if cell))


def print_records(columns: dict[str, str], records: Iterable[dict[str, Any]]) -> None:
    """A table of records: by title the name of a field and its format, as `seconds:.1f`; what is None is blank."""
    rows = [[_cell(record, *column.partition(":")[::2]) for column in columns.values()] for record in records]
    print_table([*columns], rows)


def _cell(record: dict[str, Any], name: str, form: str) -> str:
    return "" if record[name] is None else format(record[name], form)


def _tags(record: dict[str, Any]) -> str:
    return " ".join(map("=".join, record["tags"].items()))


def print_diff(found: dict[str, Any]) -> None:
    def cell(value: Any) -> str:
        return f"{value:.6g}" if isinstance(value, float) else "-" if value is None else str(value)

    warn(found.get("warnings", ()))
    named = [(name, *map(cell, pair)) for name, pair in found["settings"].items()]
    if named:
        print_table(("setting", "baseline", "run"), named)
    print_table(("figure", "baseline", "run", "change"), [(k, *map(cell, v)) for k, v in found["figures"].items()])
    if found["seconds"]:
        print_table(("stage", "seconds\nbaseline", "\nrun"), [(k, *map(cell, v)) for k, v in found["seconds"].items()])
    for kind, drives in found.get("drives", {}).items():
        if drives:
            print_line(f"drives {kind}", ", ".join(drives))
    for kind in ("gained", "lost"):
        pairs = [f"{query}:{match}" for query, match in found["closures"][kind]]
        if pairs:
            more = f" and {len(pairs) - 5} more (--json)" if len(pairs) > 5 else ""
            print_line(kind, f"{', '.join(pairs[:5])}{more}")


def print_next(look: str, *commands: str) -> None:
    """Where the results are, and the next commands, each on a line to be copied."""
    print_line("look at", look)
    for command in commands:
        print(f"{'next':10}{command}")


def print_info(found: dict[str, Any]) -> None:
    from vplog.verbs.info import preflight_lines

    seconds = max(found["end_ns"] - found["start_ns"], 0) / 1e9
    print(f"log       {found['path']}")
    print_line("kind", f"{found['kind']}, {plural(found['messages'], 'message')} over {seconds:.1f} s")
    topics = [topic | {"used": "yes" if topic["used"] else ""} for topic in found["topics"]]
    columns = {"topic": "name", "type": "type", "count": "count", "Hz": "rate_hz:.1f"}
    print_records(columns | {one: one for one in ("role", "used", "why")}, topics)
    for name, text in preflight_lines(found):
        print_line(name, text)
    for gap in found["gaps"]:
        print_line("gap", f"{gap['seconds']:.1f} s without {gap['what']}, {gap['after_s']:.1f} s after the start")
    for kind in ("warning", "problem"):
        for text in found[f"{kind}s"]:
            print_line(kind, text)
    if found["command"]:
        print(f"{'run' if found['ready'] else 'this works':10} {found['command']}")


def print_run(out: Path, record: dict[str, Any], truth: str | Path = "FILE.tum") -> None:
    """`out` is what the user called it; `truth` is the file to compare it with."""
    from vplog.data import Verdict

    counts, totals, named = record["counts"], record["totals"], shlex.quote(str(out))
    print_line(f"{out}:", _outcome_text(record))
    keyframes, frames, candidates = (plural(counts[f"{one}s"], one) for one in ("keyframe", "frame", "candidate"))
    print_line("", f"{keyframes} of {frames}, {candidates}:")
    for name, count in counts["verdicts"].items():
        print_line(f"{count:9d}", f"{name}: {Verdict(name).sentence}")
    warn(record["warnings"])
    print_line("took", f"{totals['seconds']:.1f} s, {totals['peak_memory_mb']:.0f} MB")
    evaluate = f"vplog evaluate {named} --truth {shlex.quote(str(truth))}"
    commands = [evaluate, f"vplog export {named} --format kitti -o FILE"]
    if record["solution"]["closures"]:
        commands.insert(1, f"vplog explain {named} --worst")
    print_next(f"{out}/report.html in a browser, {out}/result.mcap in Foxglove", *commands)


def _outcome_text(record: dict[str, Any]) -> str:
    solution = record["solution"]
    if solution["moved_m"] < _UNMOVED_M:  # the reason is what the user needs, whatever its words
        return f"the trajectory is the odometry's. {solution['reason'].strip()}"
    closures, places = (plural(solution[f"{one}s"], one) for one in ("closure", "place"))
    causes = [f"{closures} at {places}"] if solution["closures"] else []
    causes += ["the satellite fixes"] if record["gps"] else []
    unit = "m" if record.get("scale") != "unknown" else "units (its scale is unknown)"
    by = f", by {' and '.join(causes)}" if causes else ""
    return f"the trajectory moved by up to {solution['moved_m']:.2f} {unit}{by}"


def print_joint(out: Path, record: dict[str, Any]) -> None:
    for number, found in enumerate(record["maps"]):
        several = f" in one frame, map{number}.g2o" if len(found["drives"]) > 1 else " by itself"
        print_line(f"{out}:", f"{', '.join(found['drives'])}{several}")
    for pair in record["joins"]:
        text = f"{plural(pair['kept'], 'closure')} of {plural(pair['candidates'], 'candidate')}"
        print_line("", f"{pair['query_drive']} to {pair['match_drive']}: {text}")
    warn(record["warnings"])
    totals, named = record["totals"], shlex.quote(str(out))
    print_line("took", f"{totals['seconds']:.1f} s, {totals['peak_memory_mb']:.0f} MB")
    first = shlex.quote(f"{out}/{record['maps'][0]['drives'][0]}")
    print_next(
        f"{out}/DRIVE/report.html, and {out}/DRIVE/joint_trajectory.tum of each drive in a map of several",
        f"vplog evaluate {named} --truth FILE.tum", f"vplog export {first} --format kitti -o FILE",
    )  # fmt: skip


def print_evaluation(found: dict[str, Any]) -> None:
    from vplog.evaluate.closures import closure_sentences

    for number, one in enumerate(found.get("maps", [])):
        ate = one["ate_after"]
        print_line(f"map {number}", f"ATE rmse {ate['rmse_m']:.6f} m as one trajectory ({ate['alignment']})")
        for drive in one["drives"]:
            before, after = drive["ate_before"]["rmse_m"], drive["ate_after"]["rmse_m"]
            print_line(f"  {drive['drive']}:", f"ATE rmse {before:.6f} m before, {after:.6f} m after, by itself")
            _print_lines("  closures", closure_sentences(drive["closures"]))
    for pair in found.get("joins", []):
        if pair["accepted"] or pair["not_judged"]:
            _print_lines(f"  {pair['query_drive']} to {pair['match_drive']}:", closure_sentences(pair))
    for drive, why in found.get("uncovered", {}).items():
        print_status(f"warning: {drive} is left out: {why}")
    if "maps" in found:
        warn(_notes_of_drives([drive for one in found["maps"] for drive in one["drives"]]))
        return
    warn(found["warnings"])
    if found.get("closures"):
        _print_lines("closures", closure_sentences(found["closures"]))
    residuals = found.get("residuals")
    if residuals and residuals["to_truth"] is not None:
        near = "" if residuals["to_neighbours"] is None else f", {residuals['to_neighbours']:.2f} to its neighbours"
        text = (
            f"median {residuals['to_truth']:.2f} sigma to the truth{near} (consistent with their covariance: about 1)"
        )
        print_line("residuals", text)
    _print_pose_score(found.get("poses"))
    for when in ("before", "after"):
        ate, rpe, drift = found[f"ate_{when}"], found.get(f"rpe_{when}"), found.get(f"drift_{when}")
        scale = f", scale {ate['scale']:.4f}" if ate["alignment"] == "Sim(3)" else ""
        line = f"ATE rmse {ate['rmse_m']:.6f} m, max {ate['max_m']:.3f} m ({ate['alignment']}{scale})"
        if rpe is not None and rpe["count"]:
            line += f"   RPE {rpe['translation_rmse_m']:.4f} m, {rpe['rotation_rmse_deg']:.4f} deg a frame"
        print_line(when, line)
        if drift is not None and drift["segments"]:
            ends = f"{drift['lengths_m'][0]:g} to {drift['lengths_m'][-1]:g} m"
            what = f"drift {drift['translation_m']:.2f} m, {drift['rotation_deg']:.2f} deg per 100 m"
            print_line("", f"{what} (mean of {drift['segments']} segments of {ends} of path)")


def _print_pose_score(poses: dict[str, Any] | None) -> None:
    if poses and poses["nees"] is not None:
        text = f"NEES {poses['nees']:.2f} per degree of freedom (consistent with their covariance: about 1), "
        print_line("poses", f"{text}median sigma {poses['median_sigma_m']:.3g} m relative to another keyframe")
    elif poses and poses["reason"]:
        print_line("poses", f"no NEES: {poses['reason']}")


def print_evaluated_map(found: dict[str, Any]) -> None:
    figures = {"ATE m": "ate_m:.3f", "recall": "recall:.3f", "false": "false_closures"}
    between = {"closures to\nother drives": "between", "of them\nfalse": "false_between"}
    drives = [one | {"tags": _tags(one)} for one in found["drives"]]
    print_records({"drive": "drive", "tags": "tags", "vplog": "vplog", **figures, **between, "error": "error"}, drives)
    groups = [one | {"group": name} for name, one in found["groups"].items()]
    print_records({"mean of": "group", "drives": "drives", **figures}, groups)
    for one in found["components"]:
        ate, judged = one["ate_after"], one["joins"]
        counts = {name: sum(pair[name] for pair in judged) for name in ("accepted", "accepted_true", "accepted_false")}
        text = f"{', '.join(one['drives'])}: ATE rmse {ate['rmse_m']:.6f} m in one frame ({ate['alignment']})"
        if judged:
            text += "; {accepted} closures between them, {accepted_true} true, {accepted_false} false".format(**counts)
        print_line("together", text)
    warn(_notes_of_drives(found["drives"]))


def _notes_of_drives(drives: Iterable[dict[str, Any]]) -> Iterator[str]:
    """The notes about the truth, each once, with the first of the drives that it is about."""
    notes: dict[str, list[str]] = {}
    for drive in drives:
        for note in drive.get("warnings") or ():
            notes.setdefault(note, []).append(drive["drive"])
    for note, names in notes.items():
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        yield f"{', '.join(names[:_NAMED])}{more}: {note}"


def _print_lines(label: str, lines: list[str]) -> None:
    for line in lines:
        print_line(label, line)
        label = ""


def print_explanation(found: dict[str, Any]) -> None:
    print(f"closure {found['closure']} of {found['run']}")
    for name in ("verdict", "proposed", "geometry", "solver", "change"):
        print_line("to change" if name == "change" else name, found[name])
    if found["picture"]:
        print(f"{'picture':10}{found['picture']['file']}")


def print_opened(found: dict[str, Any]) -> None:
    if not found["opened"]:
        print_line(f"{found['run']}:", f"not opened, as {found['why']}: {found['path']}")
    elif found["viewer"] == "rerun":
        print_line(f"{found['run']}:", "opens in rerun, until its window is closed")
    else:
        where = "in the browser" if found["viewer"] == "report" else "in Foxglove"
        print_line(f"{found['run']}:", f"{found['path']} opens {where}")


def print_setting(found: dict[str, Any]) -> None:
    value, default = (json.dumps(found[name], ensure_ascii=False) for name in ("value", "default"))
    print(f"{found['setting']}: {value}")
    print_line("", " ".join(found["description"].split()))
    if found["allowed"]:
        print_line("allowed", found["allowed"])
    if value != default:
        print_line("default", default)


def print_questions(found: dict[str, Any]) -> None:
    if not found["questions"]:
        print(f"{found['run']}: no closure is left to ask about")
        return
    columns = {
        "query": "query", "match": "match", "query\nstamp ns": "query_stamp_ns", "match\nstamp ns": "match_stamp_ns",
        "verdict": "verdict", "p_false": "p_false:.3f", "wrong": "p_wrong:.3f", "moves\nm": "moved_m:.3f",
    }  # fmt: skip
    records = [one | {"rows": len(one["closures"])} for one in found["questions"]]
    print_records(columns | {"rows": "rows"}, records)
    pictures = [one["picture"] for one in found["questions"] if one["picture"]]
    if pictures:
        print(f"{'pictures':10}{os.path.dirname(pictures[0])}")  # noqa: PTH120
    warn(found["warnings"])
    print_line("answer", f"accept or reject, in the third column: {found['decisions']}")
    print(f"{'next':10}{found['command']}")


def print_optimised(found: dict[str, Any]) -> None:
    print(
        f"{found['output']}: {found['poses']} poses, {found['edges']} edges; of {found['loops']} closures "
        f"{found['kept']} were accepted, {found['rejected']} rejected"
    )
    print(f"  error {found['error_before']:.6g} before, {found['error_after']:.6g} after (half the chi-square)")
    print(f"  {found['reason']}")
    if "certificate" in found:
        print(f"  {found['certificate']['reason']}")
    warn(found["warnings"])
    print(f"  {sum(found['seconds'].values()):.2f} s")


def print_batch(found: dict[str, Any]) -> None:
    costs = ("attempts", "seconds", "peak_memory_mb")
    rows = [one | {name: one[name] or None for name in costs} for one in found["drives"]]
    rows = [one | ({} if one["state"] == "computed" else {"keyframes": None, "accepted": None}) for one in rows]
    columns = {
        "drive": "drive", "state": "state", "keyframes": "keyframes", "closures": "accepted",
        "closures to\nother drives": "between", "attempts": "attempts", "seconds": "seconds:.1f",
        "peak MB": "peak_memory_mb:.0f", "worker": "worker", "error": "error",
    }  # fmt: skip
    print_records(columns, rows)
    drives, threads = plural(len(found["drives"]), "drive"), plural(found["threads_per_job"], "thread")
    print_line(
        f"{found['map']}:",
        f"{drives}, {found['failed']} failed, {found['seconds']:.1f} s, {found['jobs']} at once, {threads} each",
    )
    _print_components((found["joined"] or {}).get("components", []))
    for drive in found["drives"]:
        for warning in drive["warnings"]:
            print_status(f"warning: {drive['drive']}: {warning}")
    warn(found["warnings"] + (found["joined"] or {}).get("warnings", []))
    named = shlex.quote(str(found["map"]))
    look = f"{found['map']}/runs/drive=ID/report.html of each drive"
    print_next(look, f"vplog map info {named}", f"vplog map query {named} LOG")


def print_dry_run(found: dict[str, Any]) -> None:
    sizes = {"bytes": "bytes", "images": "images", "seconds": "seconds:.1f"}
    drives = [one | {"tags": _tags(one)} | ({} if one["images"] else dict.fromkeys(sizes)) for one in found["drives"]]
    print_records({"drive": "drive", "would": "state", **sizes, "tags": "tags", "error": "error"}, drives)
    known = found["cpu_seconds_from"]
    source = f"as {plural(known, 'drive')} of the map took" if known else "as no drive of the map says otherwise"
    print_line(
        f"{found['map']}:",
        f"{found['compute']} of {plural(len(found['drives']), 'drive')} to compute, {found['bytes'] / 1e9:.3g} GB, "
        f"{plural(found['images'], 'image')}",
    )
    print_line("takes", f"{found['cpu_hours']:.3g} CPU hours, {found['cpu_seconds_per_image']:.3g} s an image {source}")
    if found["cost"] is not None:
        print_line("costs", f"{found['cost']:.2f}")


def print_map(found: dict[str, Any]) -> None:
    known = found["library"]
    each = "" if found["bytes_per_place"] is None else f", {found['bytes_per_place']:g} bytes a place"
    drives, places = plural(len(found["drives"]), "drive"), plural(found["places"], "place")
    print(f"{found['map']}: {drives}, {places}{each}, {found['bytes'] / 1e6:.1f} MB")
    print(f"library   {known['hash'] or 'none yet'}, {plural(known['references'] or 0, 'reference')}")
    boxes = [drive["bounds"] for drive in found["drives"] if drive["bounds"]]
    sides = zip((min, min, max, max), zip(*boxes, strict=True), strict=False)  # no side where there is no box
    where = ",".join(f"{most(side):.5f}" for most, side in sides)
    around = f", within {where} (south, west, north, east)" if boxes else ""
    print(f"on earth  {found['on_earth']} of {drives}{around}")
    if found["components"] is not None:
        joined = sum(len(one["drives"]) for one in found["components"])
        groups = len(found["components"])
        closures = sum(one["between"] or 0 for one in found["drives"]) // 2  # each has two ends
        by = f"by {plural(closures, 'closure')}"
        print(f"joined    {plural(joined, 'drive')} in {plural(groups, 'group')} {by}, each in one frame")
    costs = ("seconds", "peak_memory_mb")
    drives = [
        one | {name: one[name] or 0 for name in costs} | {"mb": one["bytes"] / 1e6, "tags": _tags(one)}
        for one in found["drives"]
    ]
    columns = {name: name for name in ("drive", "keyframes", "candidates", "accepted")}
    columns |= {"to other\ndrives": "between", "MB": "mb:.1f", "seconds": "seconds:.1f"}
    columns |= {"peak MB": "peak_memory_mb:.1f", "tags": "tags"}
    print_records(columns, drives)
    for drive, failure in found["failures"].items():
        print_status(f"failed: {drive}: {failure['error']}")
    warn(found["problems"])
    for line in found["damaged_files"]:
        print_status(f"damaged: {line}")


def print_export(found: dict[str, Any]) -> None:
    for drive in found.get("left_out", ()):
        print_status(
            f"warning: {drive} is left out: it has no place on earth, as its log has fewer than three satellite fixes."
        )
    warn(found.get("warnings", ()))
    print(f"{found['written']}: {plural(found['places'], 'place')} of {plural(len(found['drives']), 'drive')}")


def print_joined(found: dict[str, Any]) -> None:
    print(f"{found['map']}: {plural(found['pairs'], 'pair')} of drives compared, {found['pairs_computed']} of them now")
    _print_components(found["components"])
    if found["alone"]:
        print_line("alone", ", ".join(found["alone"]))
    warn(found["warnings"])
    named = shlex.quote(str(found["map"]))
    print_next(f"{found['map']}/joint/KEY of the drives together", f"vplog evaluate {named} --truth FILE.tum")


def _print_components(components: list[dict[str, Any]]) -> None:
    """Print the drives of each component of a join, with the closures between them."""
    for component in components:
        closures = sum(component["between"].values()) // 2  # each has two ends
        text = f"{', '.join(component['drives'])}, by {plural(closures, 'closure')}, in joint/{component['folder']}"
        print_line("together", text)


def print_merge(found: dict[str, Any]) -> None:
    for one in found["drives"]:
        other = "" if one["as"] == one["drive"] else f" as {one['as']}"
        print(f"{one['state']:14}{one['drive']}{other}, from {one['from']}")
    warn(found["warnings"])
    taken = sum(one["state"] != "there already" for one in found["drives"])
    print(f"{found['map']}: {taken} of {plural(len(found['drives']), 'drive')} taken")
    if any(one["state"] == "taken" for one in found["drives"]):
        print(f"next      vplog map join {shlex.quote(str(found['map']))}")


def print_removed(found: dict[str, Any]) -> None:
    print(f"{found['map']}: {len(found['removed'])} removed, {plural(len(found['drives']), 'drive')} left")
    if found["still_joined"]:
        print_line("to solve", f"{', '.join(found['still_joined'])} were joined with what is removed")
        print(f"next      vplog map join {shlex.quote(str(found['map']))}")
    warn(found["warnings"])


def print_snapshots(found: dict[str, Any]) -> None:
    for one in found["snapshots"]:
        print(f"{one['version']:6}  {one['time']}  {plural(one['drives'], 'drive'):>14}  {one['change']}")


def print_delta(found: dict[str, Any]) -> None:
    print(f"{found['map']}: {_delta_state(found)}")
    print("\n".join(found["tables"]))


def print_compacted(found: dict[str, Any]) -> None:
    print(f"{found['map']}: {plural(found['files'], 'file')} of drives put into {plural(found['packs'], 'pack')}")
    if found["delta"] is not None:
        print(f"Delta tables: {_delta_state(found['delta'])}")


def _delta_state(found: dict[str, Any]) -> str:
    counts = f"{plural(found['drives'], 'drive')} in {plural(found['files'], 'file')} each"
    return f"version {found['version']}, {counts}"


def print_vacuumed(found: dict[str, Any]) -> None:
    print(f"{found['map']}: {plural(found['objects'], 'object')} removed, {found['bytes'] / 1e6:.1f} MB")


def print_condensed(found: dict[str, Any]) -> None:
    rows = [
        (one["drive"], *(str(one["places"][end]) for end in ("before", "after")), str(one["faded"]),
         *(f"{one['descriptor_bytes'][end] / 1e3:.1f}" for end in ("before", "after")))
        for one in found["drives"]
    ]  # fmt: skip
    print_table(("drive", "places", "kept", "faded", "kB", "kept kB"), rows)
    warn(found["warnings"])
    queries, recall, places, size = found["queries"], found["recall"], found["places"], found["descriptor_bytes"]
    print(
        f"own queries  {queries['places']}: {queries['by_other_drives']} answered by other drives, "
        f"{queries['by_own_drive']} by their own, {queries['alone']} by no other place, "
        f"within {found['distance_m']:g} m"
    )
    after = f"{recall['after']:.4f} after, by queries that did not choose what goes"
    print(f"recall       {recall['before']:.4f} before, {after}; {found['loss']:g} may be lost")
    if found["faded"]["found"]:
        print(f"faded        {found['faded']['found']} places, {found['faded']['removed']} of them removed")
    library, known = found["library_bytes"], found["references"]
    named = "" if known is None else f"{known['after']} of {plural(known['before'], 'reference')}, "
    print(f"library      {named}{library['after'] / 1e6:.2f} of {library['before'] / 1e6:.2f} MB")
    print(
        f"{found['written']}: {places['after']} of {plural(places['before'], 'place')}, "
        f"{size['after'] / 1e3:.1f} of {size['before'] / 1e3:.1f} kB of descriptors"
    )


def print_index(found: dict[str, Any]) -> None:
    places, drives = plural(found["places"], "place"), plural(len(found["drives"]), "drive")
    files = plural(len(found["segments"]), "file")
    print(f"{found['map']}: {places} of {drives} in {files}, {found['bytes'] / 1e6:.1f} MB")
    warn(found["warnings"])


def print_redescribed(found: dict[str, Any]) -> None:
    for one in found["drives"]:
        other = "" if one["was"] == one["drive"] else f", was {one['was']}"
        print(f"{one['state']:10}{one['drive']}{other}{': ' if one['error'] else ''}{one['error']}")
    print(f"{found['map']}: {plural(len(found['drives']) - found['failed'], 'drive')}, library {found['library']}")
    warn((found["joined"] or {}).get("warnings", []))
    print(f"next      vplog map query {shlex.quote(str(found['map']))} LOG")


def print_answers(found: dict[str, Any]) -> None:
    """The best place of every view; all of them are in the file and in the JSON."""
    best = [{"query_name": one["query"], "match_name": one["keyframe"]} | one for one in found["answers"]]
    columns = {"view": "query_name", "drive": "drive", "keyframe": "match_name"}
    columns |= {"score": "score:.3f", "support": "support", "p_match": "p_match:.2f"}
    print_records(columns, [one for one in best if one["rank"] == 0])
    warn(found["warnings"])
    views = plural(found["views"], "view")
    print(f"{found['log']}: {found['answered']} of {views} matched to a place of {found['map']}")
    if found["written"]:
        print(f"written   {found['written']}")


def print_localized(found: dict[str, Any]) -> None:
    """The pose of every picture that has one, and why the others have none."""
    localized = [one | {"at": f"{one['drive']}:{one['keyframe']}"} for one in found["answers"] if one["localized"]]
    columns = {"picture": "picture", "x\nm": "tx:.3f", "y\nm": "ty:.3f", "z\nm": "tz:.3f", "sigma\nm": "sigma_m:.2g"}
    columns |= {"sigma\ndeg": "sigma_deg:.2g", "inliers": "inliers", "at": "at"}
    if localized:
        print_records(columns, localized)
    for one in found["answers"]:
        if not one["localized"]:
            print_line(f"{one['picture']}:", one["sentence"])
    warn(found["warnings"])
    print(f"{found['localized']} of {plural(found['pictures'], 'picture')} localised in {found['map']}")
    if found["written"]:
        print(f"written   {found['written']}")


def print_comparison(found: dict[str, Any]) -> None:
    truth = f", {found['positives']} with a true match," if found["truth"]["source"] is not None else ""
    print_line(
        f"{found['queries']}",
        f"queries{truth} against {found['map_frames']} frames; library of {found['library']['size']} images",
    )
    shares = {
        "r_at_1": "R@1", "r_at_5": "R@5", "r_at_10": "R@10", "anr": "ANR\n%", "ap": "AP", "recall_at_p100": "R@\nP100",
        "f1": "F1",
    }  # fmt: skip
    if any((lost := found["undecodable"]).values()):
        print_line(
            "undecodable",
            f"{lost['queries']} of the queries and {lost['map_frames']} of the frames; for methods that need pixels "
            "they count as not found",
        )
    times = {"mining_ms": "encode\nown ms", "feature_ms": "encode\nshared ms", "query_ms": "query\nms"}
    if not found["positives"]:
        shares = {}
        _print_best_answers(found["answers"])
    nowhere = any(one.get("open_set", {}).get("auroc") is not None for one in found["methods"].values())
    titles = [*shares.values(), *(("AUROC", "R@1%\nalarms") if truth and nowhere else ()), "bytes"]
    rows: list[Sequence[str]] = []
    for name, method in found["methods"].items():
        costs = [""] * (1 + len(times))  # answers from a file have none
        if "bytes_per_image" in method:
            costs = [f"{method['bytes_per_image']:g}", *(f"{method[time]:.2f}" for time in times)]
        rows.append((name, *_shares(method, shares, nowhere), *costs))
        if "sequence" in method and shares:
            scores = method["sequence"]
            rows.append((f"  L={scores['length']}", *_shares(scores, shares, nowhere), *[""] * (1 + len(times))))
    print_table(("method", *titles, *times.values()), rows)
    print_line("protocol", found["protocol"]["text"])
    warn(found["warnings"])


def _shares(scores: dict[str, Any], names: Iterable[str], nowhere: bool) -> list[str]:
    """Figures of a method, those of queries without a match last."""
    found = [scores[name] for name in names]
    if found and nowhere:
        found += [scores["open_set"][name] for name in ("auroc", "recall_at_1_percent_false_alarms")]
    return [f"{value:.3f}" for value in found]


def _print_best_answers(answers: list[dict[str, Any]] | str) -> None:
    """The best answer to every query, a column for each method; where they were written, where."""
    if isinstance(answers, str):
        print_line("answers", answers)
        return
    by_query: dict[int, dict[str, str]] = {}
    for one in answers:
        row = by_query.setdefault(one["query"], {"query": one["query_name"] or str(one["query"])})
        row[one["method"]] = "" if one["match"] is None else one["match_name"] or str(one["match"])
    titles = list(dict.fromkeys(title for row in by_query.values() for title in row))
    print_table(titles, [[row.get(title, "") for title in titles] for row in by_query.values()])


def print_study(out: Path, found: dict[str, Any]) -> None:
    """Methods by pair of drives, departures from the paper, and where the rest is."""
    done = found["experiments"]
    scores = ("r_at_1", "anr", "ap")
    if "pairs" in done:
        rows = done["pairs"]["rows"]
        pairs = dict.fromkeys((row["query"], row["map"]) for row in rows)
        table = []
        for mean in done["pairs"]["mean"]:
            cells = [f"{r['r_at_1']:.2f} / {r['anr']:.2f}" for r in rows if r["method"] == mean["method"]]
            cells += [f"{mean['r_at_1']:.3f} / {mean['anr']:.2f}"]
            cells += [f"{mean['r_at_1_worst']:.2f} / {mean['anr_worst']:.2f}", f"{mean['bytes_per_image']:g}"]
            cells.append("" if mean["p_match_error"] is None else f"{mean['p_match_error']:.2f}")
            table.append((mean["method"], *cells))
        print_table(
            ("R@1 / ANR %", *(f"{a}\nin {b}" for a, b in pairs), "mean", "worst", "bytes", "p_match\nerror"), table
        )
    titles = ("R@1", "ANR %", "AP")
    if "sizes" in done:
        rows = done["sizes"]["mean"]
        table = [(str(row["size"]), row["method"], *(f"{row[score]:.3f}" for score in scores)) for row in rows]
        print_table(("library size", "method", *titles), table)
    if "ablations" in done:
        rows = done["ablations"]["rows"]
        table = [(row["name"], row["setting"], *(f"{row[f'{score}_change']:+.3f}" for score in scores)) for row in rows]
        print_table(("bobb without", "setting", *titles), table)
    for text in dict.fromkeys(one["text"] for one in found["protocol"]):
        print_line("protocol", text)
    warn(found["warnings"])
    figures = sum(len(one["figures"]) for one in done.values()) // 2
    print_line(f"{out}:", f"study.json, and {figures} figures as PNG and SVG")


def print_result(
    arguments: argparse.Namespace, found: dict[str, Any], print_text: Callable[[dict[str, Any]], None]
) -> None:
    """One JSON object with --json, else in words."""
    (print_json if arguments.json else print_text)(found)


def print_json(tree: dict[str, Any]) -> None:
    from vplog.storage.json_records import plain

    print(json.dumps(plain(tree), indent=2, ensure_ascii=False, allow_nan=False))
