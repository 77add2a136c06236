"""The picture of a closure: both frames, the features that agree, and the boxes on the references they share."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import ACCEPTED, Bytes, Floats
from vplog.results.report.charts import subsampled
from vplog.run.figures.canvas import as_text, saved_figure
from vplog.verbs.explain_text import Explanation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from vplog.run.figures.closure_view import Agreement, SharedBoxes

_COLOURS = ("#ff9d2e", "#4cc3ff", "#ff5fa8", "#b9e04a")
"""One for each reference drawn, apart from each other and from the lines, bright on grey pictures."""
_AGREES, _OTHER = "#35e06f", "#ff4d3d"
_MOST_LINES = 150
"""Lines of either kind that are drawn, subsampled: more hide the picture."""
_WIDTH_IN = 12.0
_CHARACTERS = 195
"""Characters of a caption line, at 8 points, along that width."""
_WIDE = 2.0
"""Images wider than this, against their height, are drawn one above the other."""
_GAP = 0.02
"""Between the two images, as a share of the width."""


@dataclass(frozen=True, eq=False)
class ClosureFigure:
    """All that the picture shows."""

    number: int
    row: dict[str, Any]
    explanation: Explanation
    query: Bytes
    """(H, W) grey."""
    match: Bytes
    agreement: Agreement
    boxes: list[SharedBoxes]
    missing: str
    """Reason that there are no boxes."""


def draw(path: Path, view: ClosureFigure) -> None:
    """Write the picture, a .png or .svg by its name: the same bytes for the same closure."""
    height, width = view.query.shape
    stacked = width > _WIDE * height
    frames_in = _WIDTH_IN * height / width * (2.0 if stacked else 0.5)
    boxes_in = 0.35 + max((_WIDTH_IN / 4 * b.image.shape[0] / b.image.shape[1] for b in view.boxes), default=-0.35)
    caption = textwrap.wrap(_caption(view), _CHARACTERS)
    kind = "svg" if path.suffix == ".svg" else "png"
    with saved_figure(
        path.parent, path.stem, _WIDTH_IN, frames_in + boxes_in + 0.75 + 0.16 * len(caption), (kind,)
    ) as figure:
        figure.suptitle(as_text(_title(view)), x=0.01, ha="left", fontsize=12, fontweight="bold")
        figure.supxlabel(as_text("\n".join(caption)), x=0.01, ha="left", fontsize=8, color="#444444")
        heights = (frames_in, boxes_in) if view.boxes else (frames_in,)
        grid = figure.add_gridspec(len(heights), len(_COLOURS), height_ratios=heights)
        _frames(figure.add_subplot(grid[0, :]), view, stacked)
        for column, boxes in enumerate(view.boxes):
            _reference(figure.add_subplot(grid[1, column]), boxes, view.row, _COLOURS[column])


def _title(view: ClosureFigure) -> str:
    row = view.row
    outcome = "accepted" if row["verdict"] in ACCEPTED else f"rejected: {row['verdict'].replace('_', ' ')}"
    return f"Closure {view.number}: keyframe {row['query']} as a return to keyframe {row['match']}, {outcome}"


def _caption(view: ClosureFigure) -> str:
    a = view.agreement
    count = int(a.agrees.sum())
    sentences = [
        f"{view.explanation.verdict}",
        f"{len(a.agrees)} feature matches; "
        + (
            f"green: the {count} that agree with {a.model}; red: the others."
            if a.model
            else "no more of them agree with any one geometry than would by chance, so all are red."
        ),
    ]
    if max(count, len(a.agrees) - count) > _MOST_LINES:
        sentences.append(f"At most {_MOST_LINES} lines of each are drawn.")
    if view.boxes:
        sentences.append(
            "Coloured: parts of the two views found in one spot of a reference image below. There, whole lines are "
            "all boxes of the query, dashed ones those of the match, thick the pair shown above."
        )
    else:
        sentences.append(f"No boxes: {view.missing or 'those on the references shared have nothing in common'}.")
    return " ".join(sentences)


def _frames(axes: Axes, view: ClosureFigure, stacked: bool) -> None:
    """Both frames in one coordinate frame, the query's px, so that lines may cross from one to the other."""
    height, width = view.query.shape
    other_height, other_width = view.match.shape
    gap = _GAP * width
    offset = np.array([0.0, height + gap]) if stacked else np.array([width + gap, 0.0])
    whole = offset + np.array([other_width, other_height])
    axes.set_axis_off()
    for side, at, name in ((view.query, np.zeros(2), "query"), (view.match, offset, "match")):
        high, wide = side.shape
        axes.imshow(
            side, cmap="gray", vmin=0, vmax=255, interpolation="antialiased",
            extent=(at[0], at[0] + wide, at[1] + high, at[1]),
        )  # fmt: skip
        row = view.row
        text = f"{name}: keyframe {row[name]}, {row[f'{name}_stamp_ns']} ns"
        axes.text(at[0] + 0.006 * width, at[1] + 0.006 * width, text, va="top", fontsize=8, color="white",
                  bbox={"facecolor": "black", "alpha": 0.6, "pad": 1.5, "linewidth": 0})  # fmt: skip
    axes.set(xlim=(0, max(width, whole[0])), ylim=(max(height, whole[1]), 0), aspect="equal")
    _lines(axes, view.agreement, offset + 0.5)
    for number, boxes in enumerate(view.boxes):
        # each a little smaller than the one before, so that equal windows are all seen
        for window, side, at in ((boxes.query_window, view.query, 0.0), (boxes.match_window, view.match, offset)):
            low = _rectangle(axes, window, side, at, 0.006 * (number + 1), edgecolor=_COLOURS[number])
            axes.text(low[0] + 0.03 * number * width, low[1], str(boxes.reference), va="bottom", fontsize=8,
                      bbox={"facecolor": _COLOURS[number], "pad": 1.0, "linewidth": 0})  # fmt: skip


def _lines(axes: Axes, agreement: Agreement, offset: Floats) -> None:
    from matplotlib.collections import LineCollection

    for wanted, colour, width, alpha in ((False, _OTHER, 0.4, 0.6), (True, _AGREES, 0.5, 0.8)):
        rows = subsampled(np.flatnonzero(agreement.agrees == wanted), _MOST_LINES)
        ends = np.stack([agreement.query[rows] + 0.5, agreement.match[rows] + offset], axis=1)
        axes.add_collection(LineCollection(list(ends), colors=colour, linewidths=width, alpha=alpha), autolim=False)
        points = ends.reshape(-1, 2)
        axes.scatter(points[:, 0], points[:, 1], 3.0, colour, linewidths=0, alpha=0.9)


def _rectangle(axes: Axes, corners: Floats, image: Bytes, at: Floats | float, inset: float, **style: Any) -> Floats:
    """Draw a box given in shares of an image whose corner is `at`; its lower left corner."""
    from matplotlib.patches import Rectangle

    height, wide = image.shape
    size = np.array([wide, height])
    low, high = corners[:2] * size + at + inset * wide, corners[2:] * size + at - inset * wide
    axes.add_patch(Rectangle(tuple(low), *(high - low), fill=False, **(dict[str, Any](linewidth=1.2) | style)))
    return np.array([low[0], high[1]])


def _reference(axes: Axes, boxes: SharedBoxes, row: dict[str, Any], colour: str) -> None:
    """One reference with the boxes of both views on it."""
    height, width = boxes.image.shape
    axes.imshow(boxes.image, cmap="gray", vmin=0, vmax=255, extent=(0, width, height, 0))
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.set_axis_off()
    for corners, style, best in ((boxes.query_boxes, "-", boxes.best[0]), (boxes.match_boxes, "--", boxes.best[1])):
        for number, one in enumerate(corners):
            if np.isfinite(one).all():
                inset = 0.0 if style == "-" else 0.008
                line = {"edgecolor": colour, "linewidth": 2.0 if number == best else 0.6, "linestyle": style}
                _rectangle(axes, one, boxes.image, 0.0, inset, **line)
    share = row["shared_overlap"][row["shared_references"].index(boxes.reference)]
    axes.set_title(f"reference {boxes.reference}: {100 * share:.0f} % in common", fontsize=8.5)
