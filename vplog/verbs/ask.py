"""Questions about a finished run: the closures to look at first, their pictures, and a file to answer in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vplog.data import Closures, Keyframes, Verdict
from vplog.results import mcap_read, run_record, tables
from vplog.results.collage import FramePanel, collage
from vplog.results.previews import jpeg
from vplog.results.report.page import ClosureQuestion
from vplog.run.decisions import decided_lines, write_decisions
from vplog.run.questions import ask_ledger
from vplog.storage.image_file import decode_image
from vplog.storage.scratch import replacing

_QUALITY = 80
"""JPEG quality."""
_BY_DECISION = {Verdict.ACCEPTED_BY_DECISION: "accept", Verdict.REJECTED_BY_DECISION: "reject"}


def ask(folder: Path, count: int = 10, output: Path | None = None) -> dict[str, Any]:
    """The `count` questions about the run in `folder` whose answers are expected to move its map most.

    Written to `output` (`questions` in the run folder where None): pictures of the pairs, and decisions.csv with the
    answers so far, which stay, and open lines for these questions. Raises VplogError with one line.
    """
    record = run_record.read_single_run(folder)
    if output is None:
        run_record.check_own_folder(folder, "folder")
        output = folder / "questions"
    keyframes, poses = tables.read_keyframes(folder / "keyframes.parquet")
    closures = tables.read_closures(folder / "closures.parquet")
    graph, weight, _ = tables.read_edges(folder / "edges.parquet", poses)
    path = output / "decisions.csv"
    lines = _answered(path, keyframes, closures)
    row_at = {pair: row for row, pair in enumerate(zip(closures.query.tolist(), closures.match.tolist(), strict=True))}
    answers = {row_at[q, m]: one != "reject" for q, m, one, *_ in lines if (q, m) in row_at}
    found = ask_ledger(graph, weight, closures, answers)
    chosen = found[:count]
    write_decisions(path, keyframes, lines + [line for one in chosen for line in _open(one, closures)])
    pictures = _pictures(chosen, folder, output, keyframes, closures)
    return {
        "run": str(folder),
        "questions": [_described(one, pictures, keyframes, closures) for one in chosen],
        "decided": len(lines),
        "left": len(found) - len(chosen),
        "decisions": str(path),
        "warnings": run_record.unit_warnings(record),
        "command": run_record.command_of(record, folder, "--decisions", path),
    }


def _answered(path: Path, keyframes: Keyframes, closures: Closures) -> list[Sequence[Any]]:
    """Lines decided before: those of the file as they are, then those that the run followed and the file lacks."""
    lines: dict[tuple[int, int], Sequence[Any]] = {}
    if path.exists():
        for one in decided_lines(path, keyframes):
            lines.setdefault(one.pair, (*one.pair, one.decision, *one.about))
    for row in np.flatnonzero(closures.of(*_BY_DECISION)).tolist():
        pair = int(closures.query[row]), int(closures.match[row])
        lines.setdefault(pair, (*pair, _BY_DECISION[closures.verdict[row]]))
    return list(lines.values())


def _open(question: ClosureQuestion, closures: Closures) -> list[Sequence[Any]]:
    """Lines to answer in: one open, those of the closures that it answers for too as it is."""
    return [(closures.query[row], closures.match[row], "same" if at else "") for at, row in enumerate(question.rows)]


def _described(
    question: ClosureQuestion, pictures: dict[int, Path], keyframes: Keyframes, closures: Closures
) -> dict[str, Any]:
    row = question.rows[0]
    picture = pictures.get(row)
    return {
        "closure": row,
        "query": int(closures.query[row]),
        "match": int(closures.match[row]),
        "query_stamp_ns": int(keyframes.stamp_ns[closures.query[row]]),
        "match_stamp_ns": int(keyframes.stamp_ns[closures.match[row]]),
        "verdict": closures.verdict[row].value,
        "p_false": None if np.isnan(closures.p_false[row]) else float(closures.p_false[row]),
        "p_wrong": question.p_wrong,
        "moved_m": question.moved_m,
        "closures": question.rows,
        "picture": str(picture) if picture else None,
    }


def _pictures(
    chosen: list[ClosureQuestion], folder: Path, output: Path, keyframes: Keyframes, closures: Closures
) -> dict[int, Path]:
    """Files closure-ROW.jpg by row: as the report draws it, else both frames; none where result.mcap has no images."""
    rows = [one.rows[0] for one in chosen]
    drawn = mcap_read.read_pictures(folder / "result.mcap").pictures
    wanted = {int(keyframes.stamp_ns[end[row]]) for row in rows for end in (closures.query, closures.match)}
    images = {
        one.stamp_ns: decode_image(one.image)
        for one in mcap_read.read_images(folder / "result.mcap")
        if one.stamp_ns in wanted
    }
    written = {}
    for row in rows:
        ends = [(name, int(getattr(closures, name)[row])) for name in ("query", "match")]
        found = [(f"{name}: keyframe {at}", images.get(int(keyframes.stamp_ns[at]))) for name, at in ends]
        panels = [FramePanel(image, title, np.zeros((0, 2))) for title, image in found if image is not None]
        if row not in drawn and len(panels) < len(ends):
            continue
        content = drawn.get(row) or jpeg(collage(panels[0], panels[1], np.zeros(0, bool), []), _QUALITY)
        written[row] = output / f"closure-{row}.jpg"
        with replacing(written[row], parents=True) as stream:
            stream.write(content)
    return written
