"""Content of each section of report.html, computed from a finished run."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import USED, Bools, Closures, Floats, Ints, Keyframes, Trajectory, Verdict
from vplog.errors import plural
from vplog.geometry import geodesy, se3
from vplog.results.html import figure, mapping, render
from vplog.results.report import charts
from vplog.results.run_record import command_of, has_metres

if TYPE_CHECKING:
    from vplog.results.geo import Earth
    from vplog.results.mcap import McapContent

_MOST_ROWS = 100_000
"""Rows of the ledger in the page: 10 MB. Accepted ones first, then by score; the table file has them all."""
_AFTER_GEOMETRY = (Verdict.REJECTED_BY_SOLVER, Verdict.NOT_SIGNIFICANT, Verdict.REJECTED_BY_DECISION)
"""Verdicts of closures that geometry found and the solution leaves out."""
_MOST_LOSSES = 100
"""Rows of the table of losses; run.json has them all."""
_MOST_VIEW_BYTES = 16_000_000
"""Bytes of matches, boxes, votes and references together: with thumbnails and table the page stays below 60 MB."""
_DOUBTFUL_SIGMA = 6.5
"""Residuals of that much are red."""
_MOST_SIGMA = 10.0
"""Residuals over time are drawn up to it: those of false closures are often a thousand."""
_MOST_USED = 6
"""References shown of the most used, and of the least used."""
_FIGURES = (
    ("ATE rmse m", "ate", "rmse_m", 3),
    ("ATE max m", "ate", "max_m", 3),
    ("RPE m a frame", "rpe", "translation_rmse_m", 4),
    ("RPE degrees a frame", "rpe", "rotation_rmse_deg", 4),
    ("drift m per 100 m", "drift", "translation_m", 2),
    ("drift degrees per 100 m", "drift", "rotation_deg", 2),
)
"""Heading, error, figure and digits of the rows of the table of the truth."""


@dataclass(frozen=True, eq=False)
class TruthComparison:
    """A run compared with the truth."""

    name: str
    """The truth as it was given."""
    scores: dict[str, Any]
    """The record of `vplog evaluate --json`."""
    words: list[str] = field(default_factory=list)
    """Sentences on the closures and their criteria."""
    path: Floats | None = None
    """(T, 3) m, the truth in the frame of the trajectory; None where the truth is the log's own GPS."""
    true: Bools | None = None
    """(C,) candidates that are true: by their pose, or by place where they have none."""
    known: Bools | None = None
    """(C,) candidates that the truth covers finely enough to judge."""
    curves: dict[str, Floats] = field(default_factory=dict)
    """By what candidates are ranked: (P, 3) recall, precision and the value there, by falling value."""
    at_place: Bools | None = None
    """(C,) candidates whose two frames show one place."""
    error_m: Floats | None = None
    """(N,) distance of each keyframe to the aligned truth, NaN where that does not cover it."""
    closure_error_m: Floats | None = None
    """(C,) distance between where a candidate places its query, from its match, and where the truth does; NaN without
    a pose."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Trajectories of a run before and after the solve."""

    keyframes: Keyframes
    world_from_body: Floats
    """(N, 4, 4) of the keyframes, solved."""
    before: Trajectory
    """The odometry, laid on the first solved keyframe."""
    after: Trajectory
    found: McapContent
    """Pictures, references and fixes in result.mcap."""
    earth: Earth | None
    """Pose of the trajectory on earth, None without satellite fixes."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures of closures in the page."""

    views: Mapping[int, dict[str, Any]]
    """Matches, boxes and votes of a candidate closure by its row, see `closure_views.view`."""
    references: Mapping[int, bytes] = field(default_factory=dict)
    """JPEG of a reference by its number."""
    thumbnails: dict[int, bytes] = field(default_factory=dict)
    """Small JPEG of a keyframe by its row."""


@dataclass(frozen=True, eq=False)
class ClosureQuestion:
    """Neighbouring closures that agree with each other, as one question to a person."""

    rows: list[int]
    """Rows of the ledger, that of most inliers first: its picture is the easiest to judge."""
    p_wrong: float
    """Probability that their verdict is wrong."""
    moved_m: float
    """Root mean square distance by which the map moves where it is."""


@dataclass(frozen=True, eq=False)
class Changes:
    """A run compared with another one of its drive, the baseline."""

    found: dict[str, Any]
    """The record of `vplog diff --json`."""
    path: Floats
    """(T, 3) m, the baseline's in the frame of the run."""
    change: list[str | None]
    """By row of the ledger: `gained` or `lost`, None for what did not change."""


@dataclass(frozen=True, eq=False)
class ReportContent:
    """A finished run."""

    record: dict[str, Any]
    """Content of run.json."""
    tracks: Tracks
    covariance: Floats
    """(N, 6, 6) of the solved keyframes, NaN where unknown."""
    closures: Closures
    pictures: Pictures
    judged: TruthComparison | None = None
    changes: Changes | None = None
    questions: list[ClosureQuestion] = field(default_factory=list)
    references: Ints | None = None
    """(N, K) numbers of the references that explain each keyframe, negative for none; None without references."""


def page(content: ReportContent) -> str:
    """The whole report: the same text for the same run, but for its timings."""
    record, closures, judged = content.record, content.closures, content.judged
    counts = [(verdict, closures.verdict.count(verdict)) for verdict in Verdict]
    legend, drawn = _map(content)
    curves = charts.curves(judged.curves) if judged and judged.curves else None
    over_time, distributions, references = _over_time(content), _distributions(content), _references(content)
    shown = [*over_time, curves, *(chart for _, chart in distributions), references["chart"] if references else None]
    return render(
        "report.html",
        record=record,
        drive=content.tracks.keyframes.drive,
        certainty=_certainty(content),
        tiles=_tiles(content),
        warnings=_list(record.get("warnings")),
        losses=[_loss(one, content) for one in _list(record.get("losses")) if isinstance(one, dict)][:_MOST_LOSSES],
        map_lines=legend,
        judged=judged,
        changes=content.changes and _changes(content.changes),
        questions=_questions(content),
        unit=_unit(content),
        truth=_truth(judged) if judged else [],
        curves=curves,
        verdicts=[(verdict.value, figure(count), verdict.sentence) for verdict, count in counts if count],
        candidates=len(closures),
        audit=_audit(content, drawn),
        charts={one.label: asdict(one) for one in shown if one},
        over_time=over_time,
        distributions=distributions,
        references=references,
        stages=_stages(mapping(record.get("stages"))),
    )


def _unit(content: ReportContent) -> str:
    """Unit of length of the run."""
    return "m" if has_metres(content.record) else "units of the run"


def _tiles(content: ReportContent) -> list[tuple[str, str]]:
    """The drive in seven numbers, each with its label."""
    path_m = float(np.linalg.norm(np.diff(content.tracks.after.world_from_body[:, :3, 3], axis=0), axis=1).sum())
    stamps = content.tracks.after.stamp_ns
    totals = mapping(content.record.get("totals"))
    return [
        (figure(len(content.tracks.keyframes.stamp_ns)), "keyframes"),
        (f"{figure(path_m)} {_unit(content)}", "path"),
        (f"{figure((int(stamps[-1]) - int(stamps[0])) / 1e9 if len(stamps) else 0.0)} s", "of drive"),
        (figure(len(content.closures)), "candidates"),
        (figure(int(content.closures.accepted.sum())), "accepted closures"),
        (f"{figure(totals.get('seconds'))} s", "to compute"),
        (f"{figure(totals.get('peak_memory_mb'), 0)} MB", "peak memory"),
    ]


def _changes(changes: Changes) -> dict[str, Any]:
    """Tables of settings, figures and seconds of stages, and sentences on the closures."""
    found, rows = changes.found, changes.change
    lost = len(found["closures"]["lost"])
    gone = lost - rows.count("lost")
    return {
        "baseline": found["baseline"],
        "closures": f"{plural(len(found['closures']['gained']), 'closure')} gained, {lost} lost"
        + (f", {gone} of which are no candidates of this run" if gone else ""),
        "settings": [(name, *map(str, pair)) for name, pair in found["settings"].items()],
        "figures": [(name, *(figure(one, 3) for one in triple)) for name, triple in found["figures"].items()],
        "seconds": [(name, *map(figure, pair)) for name, pair in found["seconds"].items()],
    }


def _questions(content: ReportContent) -> list[list[Any]]:
    """Rows of the table of questions, the ledger row first."""
    closures = content.closures
    return [
        [
            (row := one.rows[0]),
            *(str(int(end[row])) for end in (closures.query, closures.match)),
            closures.verdict[row].value,
            "-" if np.isnan(closures.p_false[row]) else f"{closures.p_false[row]:.3g}",
            figure(one.p_wrong, 3),
            figure(one.moved_m, 3),
            str(len(one.rows)),
        ]
        for one in content.questions
    ]


def _certainty(content: ReportContent) -> list[str]:
    """The certificate of global optimality, and the uncertainty of the keyframes' positions."""
    found = [str(reason)] if (reason := mapping(content.record.get("certificate")).get("reason")) else []
    sigma_m, unit = _sigma_m(content.covariance), _unit(content)
    if len(sigma_m := sigma_m[np.isfinite(sigma_m)]):
        to = "where GPS measures them" if content.record.get("gps") else "the first keyframe"
        found.append(
            f"Positions of keyframes relative to {to}, one sigma along the worst axis: median "
            f"{figure(float(np.median(sigma_m)), 3)} {unit}, largest {figure(float(sigma_m.max()), 3)} {unit}."
        )
    return found


def _sigma_m(covariance: Floats) -> Floats:
    """(N,) standard deviation of positions along the worst axis, NaN where unknown."""
    sigma_m, known = np.full(len(covariance), np.nan), np.isfinite(covariance).all((1, 2))
    sigma_m[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[known, 3:, 3:])[:, -1], 0.0))
    return sigma_m


def _over_time(content: ReportContent) -> list[charts.Chart]:
    """Charts of the drive by its time: height, heading and speed, uncertainty, residuals of closures and error."""
    tracks, closures, judged = content.tracks, content.closures, content.judged
    if len(tracks.after.stamp_ns) < 2:
        return []
    sample_s, keyframe_s = ((one.stamp_ns - tracks.after.stamp_ns[0]) / 1e9 for one in (tracks.after, tracks.keyframes))
    both = [("before", "odometry", tracks.before), ("after", "optimised", tracks.after)]
    poses = [(kind, name, track.world_from_body) for kind, name, track in both]
    yaw = [(kind, name, np.degrees(np.unwrap(np.arctan2(one[:, 1, 0], one[:, 0, 0])))) for kind, name, one in poses]
    speed_s, speed = _speed(sample_s, tracks.after.world_from_body[:, :3, 3])
    unit = _unit(content)
    used, residual = closures.of(*USED), np.minimum(closures.residual_after, _MOST_SIGMA)
    dots = [("dot yes", "in the solution", used), ("dot no", "other closures", ~used)]
    solved, error_m = np.isfinite(residual), None if judged is None else judged.error_m
    residuals = [(kind, name, np.where(rows, residual, np.nan)[solved]) for kind, name, rows in dots]
    drawn: list[tuple[str, Floats, list[tuple[str, str, Floats]]]] = [
        (f"height, z in {unit}", sample_s, [(kind, name, one[:, 2, 3]) for kind, name, one in poses]),
        ("heading, yaw in degrees", sample_s, yaw),
        (f"speed in {unit}/s", speed_s, [("after", "optimised", speed)]),
        (f"position, one sigma in {unit}", keyframe_s, [("after", "one sigma", _sigma_m(content.covariance))]),
        (
            f"residual of closures in sigma, cut at {_MOST_SIGMA:.0f}",
            keyframe_s[closures.query[solved]],
            residuals,
        ),
        ("error of keyframes in m", keyframe_s, [] if error_m is None else [("truth", "error", error_m)]),
    ]
    end_s = float(sample_s[-1])
    found = [charts.over_time(lines, times, name, end_s) for name, times, lines in drawn]
    if content.references is not None:
        name = "references that explain a keyframe, by first use"
        found.append(charts.coverage(content.references, keyframe_s, name, end_s))
    return [chart for chart in found if chart is not None]


def _speed(sample_s: Floats, positions: Floats) -> tuple[Floats, Floats]:
    """Times and speeds in m/s, over a second at least: from sample to sample the noise of positions is a speed."""
    times = np.arange(0.0, sample_s[-1], max(1.0, sample_s[-1] / charts.MOST_POINTS))
    at = np.column_stack([np.interp(times, sample_s, column) for column in positions.T])
    return times[1:], np.linalg.norm(np.diff(at, axis=0), axis=1) / np.diff(times)


def _loss(loss: dict[str, Any], content: ReportContent) -> list[str]:
    """A row of the table of losses: messages, times in s, and the reason."""
    start_ns = int(content.tracks.keyframes.stamp_ns[0]) if len(content.tracks.keyframes.stamp_ns) else 0
    ends = [end for span in _list(loss.get("spans_ns")) for end in span]
    when = f"{(min(ends) - start_ns) / 1e9:.1f} to {(max(ends) - start_ns) / 1e9:.1f}" if ends else "-"
    why = f"{loss.get('reason', '')}: {loss['detail']}" if loss.get("detail") else loss.get("reason", "")
    return [loss.get("topic") or "-", figure(loss.get("messages")), figure(loss.get("of")), when, why]


def false_closures(content: ReportContent) -> Bools:
    """(C,) closures in the solution that are false by the truth; none without one."""
    judged = content.judged
    if judged is None or judged.true is None or judged.known is None:
        return np.zeros(len(content.closures), bool)
    return content.closures.of(*USED) & judged.known & ~judged.true


def _map(content: ReportContent) -> tuple[list[tuple[str, str]], dict[str, Any]]:
    """The legend, and paths and keyframes in m to the right, up and out of the map, which lies along the shortest
    axis."""
    closures, judged, position = content.closures, content.judged, content.tracks.world_from_body[:, :3, 3]
    false = false_closures(content)
    groups = [
        ("yes", "closures in the solution", closures.of(*USED) & ~false),
        ("no", "closures the solver, the false rate or a decision rejected", closures.of(*_AFTER_GEOMETRY)),
        ("false", "closures in the solution that are false", false),
        ("before", "candidates that geometry rejected", ~closures.of(*USED, *_AFTER_GEOMETRY)),
    ]
    paths = [
        ("before", "odometry", content.tracks.before.world_from_body[:, :3, 3]),
        ("after", "optimised", content.tracks.after.world_from_body[:, :3, 3]),
    ]
    if judged is not None and judged.path is not None:
        paths.insert(0, ("truth", "truth", judged.path))
    if content.changes is not None:
        paths.insert(0, ("other", "baseline, optimised", content.changes.path))
    gps, earth = content.tracks.found.gps, content.tracks.earth
    if gps is not None and earth is not None:
        fixes_m = se3.transform(
            np.asarray(np.linalg.inv(earth.enu_from_world), np.float64), geodesy.local_enu(gps).enu_m
        )
        paths.insert(0, ("gps", "GPS fixes", fixes_m))
    view = charts.map_view(np.concatenate([points for _, _, points in paths]))
    axes = dict(zip("xyz", view.T.tolist(), strict=True))
    if earth is not None:
        north = earth.enu_from_world[1, :3]
        axes["N"] = (view @ north / np.linalg.norm(north)).tolist()
    legend = [(kind, name) for kind, name, points in paths if len(points)]
    legend += [(f"dot {kind}", name) for kind, name, rows in groups if rows.any()]
    flat = [
        {"kind": kind, "points": np.round(charts.subsampled(points, charts.MOST_POINTS) @ view.T, 3).tolist()}
        for kind, _, points in paths
    ]
    error = None if judged is None or judged.error_m is None else _rounded(judged.error_m, 3)
    viewed = np.round(position @ view.T, 3).tolist()
    return legend, {"axes": axes, "paths": flat, "keyframes": viewed, "error_m": error}


def _truth(judged: TruthComparison) -> list[list[str]]:
    """Errors of the odometry and of the result, one figure a row."""
    scores = judged.scores
    rows = [
        [heading, *(figure(mapping(scores.get(f"{error}_{when}")).get(name), digits) for when in ("before", "after"))]
        for heading, error, name, digits in _FIGURES
    ]
    alignment = mapping(scores.get("ate_after")).get("alignment", "")
    return [[f"{heading} ({alignment})" if "ATE" in heading else heading, *values] for heading, *values in rows]


def _views(content: ReportContent) -> tuple[dict[str, Any], dict[str, str]]:
    """Views by ledger row, and the references that they show in base64, until the page holds enough bytes of them:
    false closures first, then those of the solution, then those of most inliers."""
    closures, left = content.closures, _MOST_VIEW_BYTES
    views, references = {}, {}
    order = np.lexsort((-closures.inliers, ~closures.of(*USED), ~false_closures(content))).tolist()
    for row in order:
        if (view := content.pictures.views.get(row)) is None:
            continue
        wanted = {str(one): jpeg for one in view["references"] if (jpeg := content.pictures.references.get(one))}
        new = {one: base64.b64encode(jpeg).decode() for one, jpeg in wanted.items() if one not in references}
        left -= len(str(view)) + sum(map(len, new.values()))
        if left < 0:
            break
        views[str(row)] = view
        references |= new
    return views, references


def _audit(content: ReportContent, drawn: dict[str, Any]) -> dict[str, Any]:
    """Data of the page's script."""
    views, references = _views(content)
    closures = content.closures
    order = np.lexsort((-closures.score.astype(np.float64), ~closures.of(*USED)))
    columns = _columns(content, sorted(order[:_MOST_ROWS].tolist()))
    start_ns = int(content.tracks.after.stamp_ns[0])
    command = command_of(content.record, "RUN", "--decisions", "decisions.csv")
    return {
        "columns": columns,
        "scales": _scales(columns, drawn["error_m"]),
        "unit": _unit(content),
        "used": [verdict.value for verdict in USED],
        "sentences": {verdict.value: verdict.sentence for verdict in Verdict},
        "stamps": list(map(str, content.tracks.keyframes.stamp_ns.tolist())),  # beyond 2^53, where JavaScript rounds
        "seconds": np.round((content.tracks.keyframes.stamp_ns - start_ns) / 1e9, 4).tolist(),
        "map": drawn,
        "views": views,
        "references": references,
        "questions": {str(one.rows[0]): one.rows for one in content.questions},
        "thumbnails": {
            name: base64.b64encode(jpeg).decode()
            for name, jpeg in [
                *((str(row), jpeg) for row, jpeg in content.pictures.thumbnails.items()),
                *((f"{n}:{row}", jpeg) for (n, row), jpeg in content.tracks.found.thumbnails.items()),
            ]
        },
        "cameras": list(map(str, _list(content.record.get("cameras")))),
        "explain": "vplog explain RUN --closure ",
        "again": command,
    }


def _scales(columns: dict[str, list[Any]], error_m: list[float | None] | None) -> dict[str, tuple[float, float]]:
    """By what dots or, with `path_error_m`, the path may be coloured: the values of green and red."""
    found = {"residual_after": (0.0, _DOUBTFUL_SIGMA)}
    for name, values in (("score", columns["score"]), ("error_m", columns.get("error_m")), ("path_error_m", error_m)):
        if known := [one for one in values or [] if one is not None]:
            most = round(float(np.quantile(known, 0.95)), 2) or 1.0
            found[name] = (most, 0.0) if name == "score" else (0.0, most)
    return found


def _columns(content: ReportContent, rows: list[int]) -> dict[str, list[Any]]:
    """Values of these rows by the name of their column; those of the truth beside the verdict, in view on a phone."""
    closures, judged = content.closures, content.judged
    columns: dict[str, list[Any]] = {"row": rows, "verdict": [closures.verdict[row].value for row in rows]}
    if judged is not None and judged.true is not None and judged.known is not None:
        true = np.where(judged.true, "yes", "no")[rows].tolist()
        columns["true"] = [one if known else None for one, known in zip(true, judged.known[rows], strict=True)]
        if judged.at_place is not None:
            columns["same_place"] = ["yes" if one else None for one in judged.at_place[rows].tolist()]
    if content.changes is not None:
        columns["change"] = [content.changes.change[row] for row in rows]
    whole = ("query", "match", "rank", "matches", "inliers", "reverse_inliers", "support")
    whole += () if closures.of_first_camera.all() else ("query_camera", "match_camera")
    shares = {"residual_before": 2, "residual_after": 2, "weight": 3, "score": 4, "spread": 3}
    columns |= {name: getattr(closures, name)[rows].tolist() for name in whole}
    columns |= {name: _rounded(getattr(closures, name)[rows], digits) for name, digits in shares.items()}
    columns["p_false"] = [float(f"{one:.3g}") if np.isfinite(one) else None for one in closures.p_false[rows].tolist()]
    length = "metres" if has_metres(content.record) else "units"
    columns[length] = _rounded(np.linalg.norm(closures.match_from_query[rows, :3, 3], axis=1), 2)
    if judged is not None and judged.closure_error_m is not None:
        columns["error_m"] = _rounded(judged.closure_error_m[rows], 2)
    columns["reverse_inliers"] = [value if value >= 0 else None for value in columns["reverse_inliers"]]
    return columns


def _rounded(values: Floats | Any, digits: int) -> list[float | None]:
    """Values for JSON: null where one is not known."""
    return [round(value, digits) if np.isfinite(value) else None for value in values.astype(np.float64).tolist()]


def _distributions(content: ReportContent) -> list[tuple[str, charts.Chart | None]]:
    """Distributions of accepted and rejected candidates, with the thresholds of the settings."""
    closures, verify = content.closures, mapping(mapping(content.record.get("settings")).get("verify"))
    metric = mapping(verify.get("metric"))
    taken, residual = closures.of(*USED), np.minimum(closures.residual_after, _MOST_SIGMA)
    shown = []
    for label, values, name, least in (
        ("score", closures.score, "", None),
        ("feature matches", closures.matches, "least matches", verify.get("min_matches")),
        ("inliers", closures.inliers, "least inliers", metric.get("min_inliers")),
        ("spread of the inliers", closures.spread, "least spread", metric.get("min_spread")),
        (f"residual after the solve in sigma, cut at {_MOST_SIGMA:.0f}", residual, "", None),
    ):
        wide = values.astype(np.float64)
        threshold = [(f"{name} {least:g}", float(least))] if isinstance(least, int | float) else []
        shown.append((label, charts.histogram(wide[taken], wide[~taken], label, threshold)))
    return shown


def _references(content: ReportContent) -> dict[str, Any] | None:
    """The number of keyframes that each reference explains; None for a recogniser without boxes."""
    library = mapping(content.record.get("library"))
    used = _list(library.get("used"))
    if not used or not all(isinstance(one, int) for one in used):
        return None
    order = sorted(range(len(used)), key=lambda number: (-used[number], number))
    split = min(_MOST_USED, (len(order) + 1) // 2)
    ends = (("Most used", order[:split]), ("Least used", order[max(split, len(order) - _MOST_USED) :]))
    jpegs, coverage = content.pictures.references, mapping(library.get("coverage"))
    return {
        "count": len(used),
        "explained": coverage.get("explained") if coverage.get("frames") else None,
        "chart": charts.columns([used[number] for number in order], "references", "keyframes"),
        "ends": [(title, [(n, jpegs[n], used[n]) for n in numbers if n in jpegs]) for title, numbers in ends],
    }


def _stages(stages: dict[str, Any]) -> list[list[str]]:
    """Time and memory of each stage."""
    names = (("seconds", 2), ("cpu_seconds", 2), ("items_per_second", 1), ("peak_memory_mb", 0))
    return [
        [name, *(figure(stage.get(field), digits) for field, digits in names)]
        for name, stage in stages.items()
        if isinstance(stage, dict)
    ]


def _list(value: Any) -> list[Any]:
    """The value where it is an array of JSON, else an empty one."""
    return value if isinstance(value, list) else []
