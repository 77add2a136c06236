"""Figures of a comparison: curves, calibration, similarity matrices, and what each method missed."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vplog.benchmark.answers import file_stem
from vplog.data import Float32s, Floats, Ints
from vplog.evaluate.open_set import reliability_of_matches
from vplog.evaluate.retrieval import Ranks, Reliability, average_precision, precision_recall, recall_at
from vplog.places.vocabulary import spread_rows
from vplog.run.figures.canvas import as_text, saved_figure

if TYPE_CHECKING:
    from vplog.benchmark.method_scores import MethodResult
    from vplog.benchmark.traversals import Traversal
    from vplog.evaluate.pairs import Pairs

FIGURES = (
    *(f"{name}.[ps][nv]g" for name in ("curves", "reliability")), "similarity.png", "misses-[0-9][0-9]-*.png",
    "answers-[0-9][0-9]-*.png",
)  # fmt: skip
"""Glob patterns of the files."""
_DEEPEST_RANK = 25
"""Last rank of the curves, as usual for recall@N in place recognition (Arandjelovic et al., NetVLAD, CVPR 2016)."""
_LINES = ("-", "--", "-.", ":")
"""One kind each time the ten colours have gone round, so that forty methods are distinct."""
_MATRIX_SIDE = 600
"""Rows and columns of a drawn matrix, at most: a figure's own pixels."""
_SHOWN = 8
"""Queries in a picture of misses: what fits a page."""
_COLUMNS = 3
"""Matrices beside each other."""


@dataclass(eq=False)
class Figures:
    """The misses, calibration and similarity matrix of each method; its scores are not held until all are drawn."""

    query: Traversal
    map: Traversal
    pairs: Pairs
    reliable: dict[str, Reliability] = field(default_factory=dict)
    """Calibration of those that state probabilities, by name."""
    matrices: dict[str, Floats] = field(default_factory=dict)

    def add(self, folder: Path, number: int, name: str, result: MethodResult) -> None:
        """Take what is needed of a method, and write the picture of its misses."""
        if result.reliability is not None:
            self.reliable[f"{name}, its own posterior"] = result.reliability
        if result.ranks.p_match is not None and self.pairs.positive.any():
            self.reliable[name] = reliability_of_matches(result.ranks)
        self.matrices[name] = reduced(result.scores)
        shown = queries_shown(result.ranks)
        if len(shown):
            kind = "misses" if self.pairs.positive.any() else "answers"
            self._draw_answers(folder, f"{kind}-{file_stem(number, name)}", name, result.ranks, shown)

    def draw(self, ranks: dict[str, Ranks], folder: Path) -> None:
        """Write the figures of all methods together."""
        if self.pairs.positive.any():
            draw_curves(ranks, folder)
        if self.reliable:
            draw_reliability(self.reliable, folder)
        draw_matrices(self.matrices, self.pairs, len(self.map), folder)

    def _draw_answers(self, folder: Path, file: str, name: str, ranks: Ranks, shown: Ints) -> None:
        """Each query beside the answer it got and, where there is a truth, that which was right."""
        scored = self.pairs.positive.any()
        titles = ("query", "given", "right")[: 3 if scored else 2]
        with saved_figure(folder, file, 2.7 * len(titles), 1.9 * len(shown) + 0.4, ("png",)) as figure:
            figure.suptitle(as_text(f"{name}: wrong answers, the most certain first" if scored else f"{name}: answers"))
            bare = {"xticks": [], "yticks": []}
            grid = figure.subplots(len(shown), len(titles), squeeze=False, subplot_kw=bare)
            for axes, query in zip(grid, shown.tolist(), strict=True):
                given, right = int(ranks.top_row[query]), int(ranks.true_row[query])
                rank = f"rank {1 + int(ranks.better[query])}" if ranks.true_given[query] else "not given"
                found = "nowhere in the map" if right < 0 else f"right, {rank}: {self.map.name_of(right)}"
                texts = (
                    f"query {self.query.name_of(query)}",
                    f"given, {ranks.top_score[query]:.3g}: {self.map.name_of(given)}", found,
                )  # fmt: skip
                true_picture = None if right < 0 else self.map.picture(right)
                sides = self.query.picture(query), self.map.picture(given), true_picture
                for one, text, image in zip(axes, texts, sides, strict=False):
                    one.set_title(as_text(_shortened(text)), fontsize=7, y=1.0)  # nothing to look for its place among
                    one.axis("off")
                    if image is not None:
                        one.imshow(image, cmap="gray", vmin=0, vmax=255)


def _shortened(text: str, most: int = 44) -> str:
    """A long title without its middle: names differ towards their end."""
    return text if len(text) <= most else f"{text[: most // 3]}...{text[-(2 * most // 3 - 3) :]}"


def queries_shown(ranks: Ranks) -> Ints:
    """Queries answered wrongly, those most certain of their answer first, at most a third of them without a match;
    where no query has a match, answers spread over the drive."""
    answered = ranks.top_row >= 0
    if not ranks.positive.any():
        rows = np.flatnonzero(answered)
        return rows[spread_rows(len(rows), _SHOWN)]
    # among rows of equal score the first may be right, and counts by halves
    wrong = np.flatnonzero(answered & (ranks.top_true <= 0.5) & (ranks.top_row != ranks.true_row))
    wrong = wrong[np.argsort(-ranks.top_score[wrong], kind="stable")]
    missed, unmatched = wrong[ranks.positive[wrong]], wrong[~ranks.positive[wrong]]
    few = min(len(unmatched), max(_SHOWN // 3, _SHOWN - len(missed)))
    return np.concatenate([missed[: _SHOWN - few], unmatched[:few]])


def reduced(scores: Float32s) -> Floats:
    """The matrix at the size it is drawn, each cell the largest score of those it covers; NaN where there is none."""
    rows, columns = (np.unique(np.linspace(0, n, min(n, _MATRIX_SIDE) + 1).astype(int))[:-1] for n in scores.shape)
    ends = np.append(rows[1:], len(scores))
    with np.errstate(invalid="ignore"):
        bands = [np.fmax.reduce(scores[a:b], axis=0) for a, b in zip(rows.tolist(), ends.tolist(), strict=True)]
        return np.fmax.reduceat(np.array(bands, np.float64), columns, axis=1)


def draw_matrices(matrices: dict[str, Floats], pairs: Pairs, count: int, folder: Path) -> None:
    """Write similarity.png: the scores of every method, and the true pairs in a panel of their own."""
    panels: dict[str, Floats] = dict(matrices)
    if pairs.positive.any():
        panels["truth"] = _truth_matrix(pairs, count)
    across = min(_COLUMNS, len(panels))
    down = -(-len(panels) // across)
    with saved_figure(folder, "similarity", 4.2 * across, 4.0 * down, ("png",)) as figure:
        grid = figure.subplots(down, across, squeeze=False).ravel()
        for axes, (name, matrix) in zip(grid, panels.items(), strict=False):
            finite = matrix[np.isfinite(matrix)]
            low, high = np.percentile(finite, (1, 99.8)) if len(finite) else (0.0, 1.0)
            axes.imshow(
                matrix, extent=(0, count, len(pairs), 0), aspect="auto", cmap="viridis", interpolation="nearest",
                vmin=low, vmax=max(high, low + 1e-12),
            )  # fmt: skip
            axes.set(title=as_text(name), xlabel="frame of the map", ylabel="query")
        for axes in grid[len(panels) :]:
            axes.axis("off")


def _truth_matrix(pairs: Pairs, count: int) -> Floats:
    """(rows, columns) 1 where a cell covers a true pair."""
    matrix = np.zeros((min(len(pairs), _MATRIX_SIDE), min(count, _MATRIX_SIDE)))
    for query in np.flatnonzero(pairs.positive).tolist():
        matrix[query * len(matrix) // len(pairs), pairs.rows(query) * matrix.shape[1] // count] = 1.0
    return matrix


def draw_curves(ranks: dict[str, Ranks], folder: Path) -> None:
    """Write curves.png and curves.svg. The same ranks give the same bytes."""
    with saved_figure(folder, "curves", 10, 4.5) as figure:
        left, right = figure.subplots(1, 2)
        for number, (plain_name, found) in enumerate(ranks.items()):
            name = as_text(plain_name)
            style = {"color": f"C{number % 10}", "linestyle": _LINES[number // 10 % len(_LINES)]}
            curve = precision_recall(found)
            left.step(
                [0.0, *curve.recall], [*curve.precision[:1], *curve.precision], where="pre",
                label=f"{name}  AP {average_precision(curve):.3f}", **style,
            )  # fmt: skip
            depth = range(1, _DEEPEST_RANK + 1)
            right.plot(
                depth, [recall_at(found, k) for k in depth], label=f"{name}  R@1 {recall_at(found, 1):.3f}", **style
            )
        left.set(xlabel="recall of the best answers", ylabel="precision", title="Precision over recall")
        right.set(xlabel="rank N", ylabel="recall@N", title="A true match among the N best", xlim=(1, _DEEPEST_RANK))
        right.set_xticks([1, *range(5, _DEEPEST_RANK + 1, 5)])
        left.set_xlim(0, 1.02)
        for axes in (left, right):
            axes.set_ylim(0, 1.02)
            axes.grid(alpha=0.3)
            axes.legend(loc="lower left" if axes is left else "lower right", fontsize=8)


def draw_reliability(found: dict[str, Reliability], folder: Path) -> None:
    """Write reliability.png and reliability.svg: of answers given with a probability, how many are right.

    Guo et al., On calibration of modern neural networks, ICML 2017, Fig. 1. Below the diagonal is over-confident. The
    bars beneath say how many answers a point is of.
    """
    with saved_figure(folder, "reliability", 5.5, 5.5) as figure:
        top, below = figure.subplots(2, 1, height_ratios=(4, 1), sharex=True)
        top.plot([0, 1], [0, 1], color="0.6", linestyle=":", label="calibrated")
        for number, (plain_name, one) in enumerate(found.items()):
            filled, colour = one.count > 0, f"C{number % 10}"
            top.plot(
                one.confidence[filled], one.accuracy[filled], marker="o", color=colour,
                label=f"{as_text(plain_name)}  ECE {one.expected_calibration_error:.3f}, "
                f"{'over' if one.overconfidence > 0 else 'under'}-confident by {abs(one.overconfidence):.3f}",
            )  # fmt: skip
            width = (one.edges[1] - one.edges[0]) / len(found)
            below.bar(one.edges[:-1] + number * width, one.count, width, align="edge", color=colour)
        top.set(ylabel="share of answers that are right", title="Reliability of the probabilities of answers")
        below.set(xlabel="probability of the best answer", ylabel="answers", xlim=(0, 1.02))
        below.set_yscale("log")  # of loop detection, most answers are improbable and few are certain
        below.set_ylim(bottom=0.5)
        top.set_ylim(0, 1.02)
        for axes in (top, below):
            axes.grid(alpha=0.3)
        top.legend(loc="best", fontsize=8)
