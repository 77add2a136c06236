"""The sections about closures: pictures, the ledger, distributions, references."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Verdict
from vplog.results.report import charts
from vplog.results.report.ledger import ledger
from vplog.results.report.parts import KEPT, figure, inline, key, part, table, text

if TYPE_CHECKING:
    from vplog.results.report.content import Content

_MOST_PICTURE_BYTES = 6_000_000
"""Of all pictures together: the page then stays below 10 MB, base64 and table included."""
_MOST_USED = 6
"""References shown of the most used, and of the least used."""
_ABOUT_PICTURES = (
    '<h3>Examples</h3><p class="quiet">Above, both frames: green the feature matches that agree with one geometry, red '
    "the others. Below, reference images that explain both, with the boxes of the query in orange and of the match in "
    'blue, and where either votes.</p><div class="pictures">'
)


def closures_section(content: Content) -> str:
    """Verdicts, examples with their pictures, the ledger."""
    counts = [(verdict, content.closures.verdict.count(verdict)) for verdict in Verdict]
    rows = [[verdict.value, figure(count), text(verdict.sentence)] for verdict, count in counts if count]
    said = ["<h2>Closures</h2>", table(["verdict", "candidates", "what it says"], rows, words=(2,))]
    left, drawn = _MOST_PICTURE_BYTES, []
    for row, data in sorted(content.pictures.items()):
        if row >= len(content.closures) or len(data) > left:
            continue
        left -= len(data)
        drawn.append(row)
        said.append(_picture(row, content) if len(drawn) > 1 else f"{_ABOUT_PICTURES}{_picture(row, content)}")
    if drawn:
        said.append("</div>")
    said.append(ledger(content, drawn))
    return "\n".join(said)


def _picture(row: int, content: Content) -> str:
    closures = content.closures
    verdict = closures.verdict[row]
    kind = "accepted" if verdict in KEPT else "rejected"
    return (
        f'<figure id="closure-{row}"><img loading="lazy" alt="closure {row}" src="{inline(content.pictures[row])}">'
        f'<figcaption><b class="{kind}">{verdict.value}</b>, closure {row}: keyframe {closures.query[row]} as a return '
        f"to {closures.match[row]}, {closures.matches[row]} matches, {closures.inliers[row]} inliers, score "
        f"{closures.score[row]:.3f}</figcaption></figure>"
    )


def distributions_section(content: Content) -> str:
    """What accepted and rejected candidates differ in, with the thresholds of the settings."""
    closures, settings = content.closures, part(content.record, "settings", "verify")
    accepted = np.array([verdict in KEPT for verdict in closures.verdict], bool)
    shown = [
        ("score", closures.score, []),
        ("feature matches", closures.matches, [("least matches", settings.get("min_matches"))]),
        ("inliers", closures.inliers, [("least inliers", part(settings, "metric").get("min_inliers"))]),
        ("spread of the inliers", closures.spread, [("least spread", part(settings, "metric").get("min_spread"))]),
        ("residual after the solve, in sigma", closures.residual_after, []),
    ]
    said = [
        "<h2>Scores and thresholds</h2>\n<p class='quiet'>How many candidates have a value: accepted ones upwards, "
        "rejected ones downwards, each to a scale of its own.</p>",
        key(("yes", "no"), {"yes": "accepted", "no": "rejected"}),
        '<div class="charts">',
    ]
    for label, values, bounds in shown:
        wide = values.astype(np.float64)
        bars = [(f"{name} {at:g}", float(at)) for name, at in bounds if isinstance(at, int | float)]
        chart = charts.histogram(wide[accepted], wide[~accepted], label, bars)
        said.append(f"<div><h3>{label[0].upper()}{label[1:]}</h3>{chart}</div>")
    return "".join([*said, "</div>"])


def references_section(content: Content) -> str:
    """How often each reference explains a keyframe; nothing for a recogniser without boxes."""
    library = part(content.record, "library")
    used = library.get("used")
    if not isinstance(used, list) or not used or not all(isinstance(one, int) for one in used):
        return ""
    order = sorted(range(len(used)), key=lambda number: (-used[number], number))
    coverage = part(library, "coverage")
    explained = coverage.get("explained") if coverage.get("frames") else None
    share = f", which explain {100 * explained:.0f} % of the frames" if isinstance(explained, int | float) else ""
    said = [
        f"<h2>Reference images</h2>\n<p>{figure(len(used))} references{share}. How many keyframes each explains, the "
        "most used first:</p>",
        f'<div class="charts">{charts.columns([used[number] for number in order], "references", "keyframes")}</div>',
    ]
    split = min(_MOST_USED, (len(order) + 1) // 2)
    ends = (("Most used", order[:split]), ("Least used", order[max(split, len(order) - _MOST_USED) :]))
    for title, numbers in ends:
        shown = [
            f'<figure><img loading="lazy" alt="reference {number}" src="{inline(content.references[number])}">'
            f"<figcaption>reference {number}: {figure(used[number])} keyframes</figcaption></figure>"
            for number in numbers
            if number in content.references
        ]
        if shown:
            said.append(f'<h3>{title}</h3><div class="pictures small">{"".join(shown)}</div>')
    return "".join(said)
