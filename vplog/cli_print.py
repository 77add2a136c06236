"""How results look on a terminal: text, tables, progress, and JSON for programs."""

from __future__ import annotations

import json
import sys
import textwrap
from contextlib import suppress
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import argparse
    from pathlib import Path
    from types import TracebackType

    from rich.console import Console

    from vplog.batch import Drive


def say(message: str) -> None:
    """A line on stderr. Where that is closed or full, no work is lost for it."""
    with suppress(OSError):
        print(f"vplog: {message}", file=sys.stderr)


def print_info(found: dict[str, Any]) -> None:
    from rich.markup import escape
    from rich.table import Table

    from vplog.info import in_words

    seconds = max(found["end_ns"] - found["start_ns"], 0) / 1e9
    print(f"log       {found['path']}\nkind      {found['kind']}, {found['messages']} messages over {seconds:.1f} s")
    table = Table("topic", "type", "count", "Hz", "role", "used", "why", box=None)
    for topic in found["topics"]:
        rate = "" if topic["rate_hz"] is None else f"{topic['rate_hz']:.1f}"
        used = "yes" if topic["used"] else ""
        cells = (topic["name"], topic["type"], str(topic["count"]), rate, topic["role"], used, topic["why"])
        table.add_row(*(escape(cell) for cell in cells))
    console(sys.stdout).print(table)
    for name, text in in_words(found):
        print(f"{name:10}{text}")
    for gap in found["gaps"]:
        print(f"gap       {gap['seconds']:.1f} s without {gap['what']}, {gap['after_s']:.1f} s behind the start")
    for warning in found["warnings"]:
        print(f"warning   {warning}")
    for problem in found["problems"]:
        print(f"problem   {problem}")
    if found["command"]:
        print(f"{'run' if found['ready'] else 'this works':10} {found['command']}")


def print_run(out: Path, record: dict[str, Any]) -> None:
    from vplog.data import Verdict

    counts = record["counts"]
    print(f"{out}: {counts['keyframes']} keyframes of {counts['frames']} frames, {counts['candidates']} candidates")
    for name, count in counts["verdicts"].items():
        print(f"  {count:6d} {name}: {Verdict(name).sentence}")
    print(f"  {record['solution']['reason']}")
    for warning in record["warnings"]:
        say(f"warning: {warning}")
    totals = record["totals"]
    print(f"  {totals['seconds']:.1f} s, {totals['peak_memory_mb']:.0f} MB")


def print_joint(out: Path, record: dict[str, Any]) -> None:
    for number, found in enumerate(record["maps"]):
        print(f"{out}: map {number}: {', '.join(found['drives'])}")
        if found["reason"]:
            print(f"  {found['reason']}")
    for tie in record["joins"]:
        residual = "" if tie["kept"] == 0 else f", median {tie['median_residual_sigma']:.2f} sigma"
        print(
            f"  {tie['query_drive']} to {tie['match_drive']}: {tie['candidates']} candidates, "
            f"{tie['verified']} verified, {tie['kept']} kept{residual}"
        )
    for warning in record["warnings"]:
        say(f"warning: {warning}")
    totals = record["totals"]
    print(f"  {totals['seconds']:.1f} s, {totals['peak_memory_mb']:.0f} MB")


def print_evaluation(found: dict[str, Any]) -> None:
    for number, one in enumerate(found.get("maps", [])):
        print(f"map {number}     ATE rmse {one['ate_after']['rmse_m']:.6f} m as one trajectory")
        for drive in one["drives"]:
            before, after = drive["ate_before"]["rmse_m"], drive["ate_after"]["rmse_m"]
            print(f"  {drive['drive']}: ATE rmse {before:.6f} m before, {after:.6f} m after, by itself")
    if "maps" in found:
        return
    closures = found.get("closures")
    if closures:
        share = {
            name: "none" if closures[name] is None else f"{closures[name]:.3f}" for name in ("precision", "recall")
        }
        print(
            f"closures  {closures['accepted']} accepted, {closures['accepted_true']} of them true "
            f"(precision {share['precision']}); {closures['revisits_found']} of {closures['revisits']} revisits found "
            f"(recall {share['recall']}); {closures['opposite']} in the opposite direction"
        )
    residuals = found.get("residuals")
    if residuals and residuals["to_truth"] is not None:
        near = "" if residuals["to_neighbours"] is None else f", {residuals['to_neighbours']:.2f} to its neighbours"
        print(f"residuals median {residuals['to_truth']:.2f} sigma to the truth{near} (honest ones have about 1)")
    for when in ("before", "after"):
        rpe = found.get(f"rpe_{when}")
        drift = (
            ""
            if rpe is None
            else f"   RPE {rpe['translation_rmse_m']:.4f} m, {rpe['rotation_rmse_deg']:.4f} deg a frame"
        )
        ate = found[f"ate_{when}"]
        print(f"{when:9} ATE rmse {ate['rmse_m']:.6f} m, max {ate['max_m']:.3f} m{drift}")


def print_explanation(told: dict[str, Any]) -> None:
    print(f"closure {told['closure']} of {told['run']}")
    for name, text in (
        ("verdict", told["verdict"]),
        ("proposed", told["proposed"]),
        ("geometry", told["geometry"]),
        ("solver", told["solver"]),
        ("to change", told["change"]),
    ):
        print(textwrap.fill(text, 110, initial_indent=f"{name:10}", subsequent_indent=" " * 10))
    if told["picture"]:
        print(f"{'picture':10}{told['picture']['file']}")


def print_optimised(found: dict[str, Any]) -> None:
    print(
        f"{found['output']}: {found['poses']} poses, {found['edges']} edges; of {found['loops']} closures "
        f"{found['kept']} were kept, {found['rejected']} rejected"
    )
    print(f"  error {found['error_before']:.6g} before, {found['error_after']:.6g} after (half the chi-square)")
    print(f"  {found['reason']}")
    for warning in found["warnings"]:
        say(f"warning: {warning}")
    print(f"  {sum(found['seconds'].values()):.2f} s")


_BATCH_COSTS = (("seconds", 1), ("peak_memory_mb", 0))
"""What the table of a batch tells of each drive, with its decimals."""


def print_batch(found: dict[str, Any]) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table("drive", "state", box=None, pad_edge=False)
    for title in ("keyframes", "closures", "attempts", "seconds", "peak MB"):
        table.add_column(title, justify="right")
    table.add_column("worker")
    table.add_column("error", overflow="fold")
    for drive in found["drives"]:
        computed = drive["state"] == "computed"
        counts = [str(drive[name]) if computed else "" for name in ("keyframes", "accepted")]
        counts += [str(drive["attempts"] or "")]
        counts += [f"{drive[name]:.{digits}f}" if drive[name] else "" for name, digits in _BATCH_COSTS]
        table.add_row(escape(drive["drive"]), drive["state"], *counts, escape(drive["worker"]), escape(drive["error"]))
    console(sys.stdout).print(table)
    print(
        f"{found['map']}: {len(found['drives'])} drives, {found['failed']} failed, {found['seconds']:.1f} s, "
        f"{found['jobs']} at once, {found['threads_per_job']} threads each"
    )
    for component in (found["joined"] or {}).get("components", []):
        print(f"together  {', '.join(component['drives'])}")
    for drive in found["drives"]:
        for warning in drive["warnings"]:
            say(f"warning: {drive['drive']}: {warning}")
    for warning in found["warnings"] + (found["joined"] or {}).get("warnings", []):
        say(f"warning: {warning}")


def print_map(found: dict[str, Any]) -> None:
    from rich.markup import escape
    from rich.table import Table

    known = found["library"]
    each = "" if found["bytes_per_place"] is None else f", {found['bytes_per_place']:g} bytes a place"
    print(
        f"{found['map']}: {len(found['drives'])} drives, {found['places']} places{each}, {found['bytes'] / 1e6:.1f} MB"
    )
    print(f"library   {known['hash'] or 'none yet'}, {known['references'] or 0} references")
    boxes = [drive["bounds"] for drive in found["drives"] if drive["bounds"]]
    sides = zip((min, min, max, max), zip(*boxes, strict=True), strict=False)  # no side where there is no box
    where = ",".join(f"{most(side):.5f}" for most, side in sides)
    around = f", within {where} (south, west, north, east)" if boxes else ""
    print(f"on earth  {found['on_earth']} of {len(found['drives'])} drives{around}")
    if found["components"] is not None:
        joined = sum(len(one["drives"]) for one in found["components"])
        groups = len(found["components"])
        print(f"joined    {joined} drives in {groups} group{'' if groups == 1 else 's'}, each in one frame")
    table = Table("drive", box=None, pad_edge=False)
    for title in ("keyframes", "candidates", "accepted", "MB", "seconds", "peak MB"):
        table.add_column(title, justify="right")
    for drive in found["drives"]:
        counts = (str(drive[name]) for name in ("keyframes", "candidates", "accepted"))
        costs = (f"{value or 0:.1f}" for value in (drive["bytes"] / 1e6, drive["seconds"], drive["peak_memory_mb"]))
        table.add_row(escape(drive["drive"]), *counts, *costs)
    console(sys.stdout).print(table)
    for drive, failure in found["failures"].items():
        say(f"failed: {drive}: {failure['error']}")
    for problem in found["problems"]:
        say(f"warning: {problem}")


def print_export(found: dict[str, Any]) -> None:
    for drive in found.get("left_out", ()):
        say(f"warning: {drive} is left out: it has no place on earth, as its log has fewer than three satellite fixes.")
    print(f"{found['written']}: {found['places']} places of {len(found['drives'])} drives")


def print_joined(found: dict[str, Any]) -> None:
    print(f"{found['map']}: {found['pairs']} pairs of drives looked at, {found['pairs_computed']} of them now")
    for component in found["components"]:
        print(f"together   {', '.join(component['drives'])}, in joint/{component['folder']}")
    if found["alone"]:
        print(f"alone      {', '.join(found['alone'])}")
    for warning in found["warnings"]:
        say(f"warning: {warning}")


def print_merge(found: dict[str, Any]) -> None:
    for one in found["drives"]:
        other = "" if one["as"] == one["drive"] else f" as {one['as']}"
        print(f"{one['state']:14}{one['drive']}{other}, from {one['from']}")
    taken = sum(one["state"] != "there already" for one in found["drives"])
    print(f"{found['map']}: {taken} of {len(found['drives'])} drives taken")
    if any(one["state"] == "taken" for one in found["drives"]):
        print(f"What joins them: vplog map join {found['map']}")


def print_redescribed(found: dict[str, Any]) -> None:
    for one in found["drives"]:
        other = "" if one["was"] == one["drive"] else f", was {one['was']}"
        print(f"{one['state']:10}{one['drive']}{other}{': ' if one['error'] else ''}{one['error']}")
    print(f"{found['map']}: {len(found['drives']) - found['failed']} drives, library {found['library']}")
    for warning in (found["joined"] or {}).get("warnings", []):
        say(f"warning: {warning}")


def print_answers(found: dict[str, Any]) -> None:
    """The best place of every view; all of them are in the file and in the JSON."""
    from rich.markup import escape
    from rich.table import Table

    table = Table("view", "drive", box=None, pad_edge=False)
    for title in ("keyframe", "score", "support"):
        table.add_column(title, justify="right")
    for answer in found["answers"]:
        if answer["rank"] == 0:
            numbers = (str(answer["keyframe"]), f"{answer['score']:.3f}", str(answer["support"]))
            table.add_row(str(answer["query"]), escape(answer["drive"]), *numbers)
    console(sys.stdout).print(table)
    for warning in found["warnings"]:
        say(f"warning: {warning}")
    print(f"{found['log']}: {found['answered']} of {found['views']} views are like a place of {found['map']}")
    if found["written"]:
        print(f"written   {found['written']}")


def print_comparison(found: dict[str, Any]) -> None:
    from rich.markup import escape
    from rich.table import Table

    print(
        f"{found['queries']} queries, {found['positives']} with a true match, against {found['map_frames']} frames; "
        f"library of {found['library']['size']} images"
    )
    table = Table(box=None, pad_edge=False)
    table.add_column("method", overflow="fold")  # what gives way where the terminal is narrow
    for title in ("R@1", "R@5", "R@10", "ANR\n%", "AP", "R@\nP100", "F1", "bytes", "encode\nms", "query\nms"):
        table.add_column(title, justify="right", no_wrap=True)
    shares = ("r_at_1", "r_at_5", "r_at_10", "anr", "ap", "recall_at_p100", "f1")
    for name, method in found["methods"].items():
        costs = [f"{method['bytes_per_image']:g}"]
        costs += [f"{method[cost]:.2f}" for cost in ("encode_ms", "query_ms")]
        table.add_row(escape(name), *(f"{method[share]:.3f}" for share in shares), *costs)
        if "sequence" in method:
            by_sequence = method["sequence"]
            table.add_row(f"  L={by_sequence['length']}", *(f"{by_sequence[share]:.3f}" for share in shares))
    console(sys.stdout).print(table)
    for warning in found["warnings"]:
        say(f"warning: {warning}")


def print_study(out: Path, found: dict[str, Any]) -> None:
    """Methods by pair of drives, departures from the paper, and where the rest is."""
    from rich.markup import escape
    from rich.table import Table

    done = found["experiments"]
    scores = ("r_at_1", "anr", "ap")
    if "pairs" in done:
        table = Table(box=None, pad_edge=False)
        table.add_column("R@1 / ANR %", overflow="fold")
        rows = done["pairs"]["rows"]
        for query, other in dict.fromkeys((row["query"], row["map"]) for row in rows):
            table.add_column(escape(f"{query}\nin {other}"), justify="right")
        for title in ("mean", "worst", "bytes"):
            table.add_column(title, justify="right", no_wrap=True)
        for mean in done["pairs"]["mean"]:
            cells = [f"{r['r_at_1']:.2f} / {r['anr']:.2f}" for r in rows if r["method"] == mean["method"]]
            cells += [f"{mean['r_at_1']:.3f} / {mean['anr']:.2f}"]
            cells += [f"{mean['r_at_1_worst']:.2f} / {mean['anr_worst']:.2f}", f"{mean['bytes_per_image']:g}"]
            table.add_row(escape(mean["method"]), *cells)
        console(sys.stdout).print(table)
    if "sizes" in done:
        table = Table("library size", "method", "R@1", "ANR %", "AP", box=None, pad_edge=False)
        for row in done["sizes"]["mean"]:
            table.add_row(str(row["size"]), escape(row["method"]), *(f"{row[score]:.3f}" for score in scores))
        console(sys.stdout).print(table)
    if "ablations" in done:
        table = Table("bobb without", "setting", "R@1", "ANR %", "AP", box=None, pad_edge=False)
        for row in done["ablations"]["rows"]:
            changes = [f"{row[f'{score}_change']:+.3f}" for score in scores]
            table.add_row(escape(row["name"]), escape(row["setting"]), *changes)
        console(sys.stdout).print(table)
    for warning in found["warnings"]:
        say(f"warning: {warning}")
    figures = sum(len(one["figures"]) for one in done.values()) // 2
    print(f"{out}: study.json, and {figures} figures as PNG and SVG")


class Progress:
    """Bars with an ETA on a terminal's stderr; silence elsewhere."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
        from rich.progress import TimeRemainingColumn as Eta

        self._tasks: dict[str, Any] = {}
        self._line_by_line = not (arguments.json or sys.stderr.isatty())
        self._bars = Progress(
            TextColumn("{task.description:<18}", markup=False),
            BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), Eta(),
            console=console(sys.stderr), disable=arguments.json or not sys.stderr.isatty(),
        )  # fmt: skip

    def __enter__(self) -> Progress:
        self._bars.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._bars.stop()

    def __call__(self, stage: str, done: int, total: int) -> None:
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total)
        self._bars.update(self._tasks[stage], completed=done, total=total)

    def tell_drive(self, drive: Drive) -> None:
        """A line for each drive of a batch where there are no bars, as in the log of a job of the night."""
        if self._line_by_line:
            say(f"{drive.drive}: {drive.state}, {drive.seconds:.1f} s{f': {drive.error}' if drive.error else ''}")


def console(stream: Any) -> Console:
    from rich.console import Console

    class Told(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # main() decides what comes of it; rich would exit with 1

    return Told(file=stream, width=None if stream.isatty() else 160)


def print_json(tree: dict[str, Any]) -> None:
    from vplog.results.run_record import plain

    print(json.dumps(plain(tree), indent=2, ensure_ascii=False, allow_nan=False))
