"""The page: its sections in order, each a function of the content. Whatever comes from outside is escaped."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Verdict
from vplog.results.report import charts
from vplog.results.report.evidence import closures_section, distributions_section, references_section
from vplog.results.report.parts import figure, key, part, table, text
from vplog.results.report.style import SCRIPT, STYLE

if TYPE_CHECKING:
    from vplog.data import Closures
    from vplog.results.report.content import Content

_MOST_LOSSES = 100
"""Rows of the table of losses; run.json has them all."""
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
"""The browser itself refuses whatever is not inside the page."""


def page(content: Content) -> str:
    """The whole report: the same text for the same run, but for its timings."""
    drive = text(content.keyframes.drive)
    sections = [
        _head(content), _warnings(content), _trajectory(content), _truth(content), closures_section(content),
        distributions_section(content), references_section(content), _costs(content), _settings(content),
    ]  # fmt: skip
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>vplog: {drive}</title>\n'
        f'<meta name="viewport" content="width=device-width,initial-scale=1">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        f'<link rel="icon" href="data:,">\n<style>\n{STYLE}\n</style></head>\n<body>\n'
        + "\n".join(section for section in sections if section)
        + f"\n<script>\n{SCRIPT}\n</script>\n</body></html>\n"
    )


def _head(content: Content) -> str:
    record, closures = content.record, content.closures
    path_m = float(np.linalg.norm(np.diff(content.after.world_from_body[:, :3, 3], axis=0), axis=1).sum())
    stamps = content.after.stamp_ns
    seconds = (int(stamps[-1]) - int(stamps[0])) / 1e9 if len(stamps) else 0.0
    totals = part(record, "totals")
    tiles = [
        (figure(len(content.keyframes.stamp_ns)), "keyframes"),
        (f"{figure(path_m)} m", "path"),
        (f"{figure(seconds)} s", "of drive"),
        (figure(len(closures)), "candidates"),
        (figure(closures.verdict.count(Verdict.ACCEPTED)), "accepted closures"),
        (f"{figure(totals.get('seconds'))} s", "to compute"),
        (f"{figure(totals.get('peak_memory_mb'), 0)} MB", "peak memory"),
    ]
    reason = part(record, "solution").get("reason", "")
    return (
        f"<h1>{text(content.keyframes.drive)}</h1>\n<p>{text(reason)}</p>\n"
        f'<p class="quiet">{text(record.get("log", ""))}, vplog {text(record.get("vplog", ""))}</p>\n'
        '<div class="tiles">'
        + "".join(f'<div class="tile"><b>{value}</b><span>{name}</span></div>' for value, name in tiles)
        + "</div>"
    )


def _warnings(content: Content) -> str:
    found = content.record.get("warnings")
    lines = [f'<p class="warn">{text(line)}</p>' for line in found] if isinstance(found, list) else []
    told = content.record.get("losses")
    rows = [_loss(one, content) for one in told if isinstance(one, dict)] if isinstance(told, list) else []
    heads = ["topic", "messages lost", "of", "seconds into the drive", "why"]
    lost = table(heads, rows[:_MOST_LOSSES], words=(4,)) if rows else ""
    return f"<h2>Losses and warnings</h2>\n{''.join(lines) or '<p>No warnings.</p>'}{lost}"


def _loss(loss: dict[str, Any], content: Content) -> list[str]:
    """A row of what could not be read: how much, when, and why."""
    start_ns = int(content.keyframes.stamp_ns[0]) if len(content.keyframes.stamp_ns) else 0
    spans = loss.get("spans_ns")
    ends = [end for span in spans for end in span] if isinstance(spans, list | tuple) else []
    when = f"{(min(ends) - start_ns) / 1e9:.1f} to {(max(ends) - start_ns) / 1e9:.1f}" if ends else "-"
    why = f"{loss.get('reason', '')}: {loss['detail']}" if loss.get("detail") else loss.get("reason", "")
    return [text(loss.get("topic") or "-"), figure(loss.get("messages")), figure(loss.get("of")), when, text(why)]


def _trajectory(content: Content) -> str:
    ends = content.world_from_body[:, :3, 3]
    segments = [("yes", _between(ends, content.closures, Verdict.ACCEPTED))]
    segments.append(("other", _between(ends, content.closures, Verdict.DIRECTION_ONLY)))
    segments.append(("no", _between(ends, content.closures, Verdict.REJECTED_BY_SOLVER)))
    paths = [("before", content.before.world_from_body[:, :3, 3]), ("after", content.after.world_from_body[:, :3, 3])]
    dots = []
    if content.judged is not None and content.judged.path is not None:
        paths.insert(0, ("truth", content.judged.path))
    if content.fixes_m is not None:
        dots.append(("gps", content.fixes_m))
    used = [kind for kind, points in (*dots, *paths, *segments) if len(points)]
    return f"<h2>Trajectory</h2>\n{key(used)}{charts.trajectory_map(paths, dots, segments)}"


def _between(ends: Any, closures: Closures, verdict: Verdict) -> Any:
    """(S, 2, 3) the ends of closures with that verdict."""
    rows = [row for row, one in enumerate(closures.verdict) if one == verdict]
    return np.stack([ends[closures.match[rows]], ends[closures.query[rows]]], axis=1).reshape(-1, 2, 3)


def _truth(content: Content) -> str:
    judged = content.judged
    if judged is None:
        return ""
    rows = []
    for name, when in (("odometry", "before"), ("optimised", "after")):
        ate, rpe, drift = (part(judged.scores, f"{name}_{when}") for name in ("ate", "rpe", "drift"))
        values = [figure(ate.get("rmse_m"), 3), figure(ate.get("max_m"), 3)]
        values += [figure(rpe.get("translation_rmse_m"), 4), figure(rpe.get("rotation_rmse_deg"), 4)]
        values += [figure(drift.get("translation_m"), 2), figure(drift.get("rotation_deg"), 2)]
        rows.append([name, *values])
    aligned = text(part(judged.scores, "ate_after").get("alignment", ""))
    heads = ["", f"ATE rmse m ({aligned})", "ATE max m", "RPE m a frame", "RPE degrees a frame"]
    heads += ["drift m per 100 m", "drift degrees per 100 m"]
    said = [f"<h2>Against the truth</h2>\n<p class='quiet'>{text(judged.name)}</p>{table(heads, rows)}"]
    said += [f"<p>{text(line)}</p>" for line in judged.words]
    if judged.curves:
        names = {"after": "candidates by score", "other": "candidates by inliers"}
        drawn = list(zip(names, judged.curves.values(), strict=False))
        said.append(f'<h3>Precision and recall</h3>{key(names, names)}<div class="charts">{charts.curves(drawn)}</div>')
    return "".join(said)


def _costs(content: Content) -> str:
    rows = []
    for name, stage in part(content.record, "stages").items():
        if isinstance(stage, dict):
            values = [figure(stage.get("seconds"), 2), figure(stage.get("cpu_seconds"), 2)]
            values += [figure(stage.get("items_per_second")), figure(stage.get("peak_memory_mb"), 0)]
            rows.append([text(name), *values])
    heads = ["stage", "seconds", "CPU seconds", "frames or candidates a second", "peak MB"]
    return f"<h2>Time and memory</h2>\n{table(heads, rows)}" if rows else ""


def _settings(content: Content) -> str:
    shown = {name: content.record.get(name) for name in ("settings", "versions", "inputs", "counts", "noise", "gps")}
    blocks = [
        f"<details><summary>{name}</summary><pre>{text(json.dumps(value, indent=1, ensure_ascii=False))}</pre>"
        "</details>"
        for name, value in shown.items()
        if value
    ]
    return f"<h2>How it was made</h2>\n{''.join(blocks)}"
