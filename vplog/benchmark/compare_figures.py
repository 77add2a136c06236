"""The figures of a comparison: precision over recall, recall over rank, and what probabilities are worth."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vplog.evaluate.retrieval import average_precision, precision_recall, recall_at
from vplog.figures.canvas import as_text, drawn

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.evaluate.calibration import Reliability
    from vplog.evaluate.retrieval import Ranks

_DEEPEST_RANK = 25
"""Last rank of the curves, as usual for recall@N in place recognition (Arandjelovic et al., NetVLAD, CVPR 2016)."""
_LINES = ("-", "--", "-.", ":")
"""One kind each time the ten colours have gone round, so that forty methods are told apart."""


def draw_curves(ranks: dict[str, Ranks], folder: Path) -> None:
    """Write curves.png and curves.svg. The same ranks give the same bytes."""
    with drawn(folder, "curves", 10, 4.5) as figure:
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
    with drawn(folder, "reliability", 5.5, 5.5) as figure:
        top, below = figure.subplots(2, 1, height_ratios=(4, 1), sharex=True)
        top.plot([0, 1], [0, 1], color="0.6", linestyle=":", label="calibrated")
        for number, (plain_name, one) in enumerate(found.items()):
            filled, colour = one.count > 0, f"C{number % 10}"
            top.plot(
                one.confidence[filled], one.accuracy[filled], marker="o", color=colour,
                label=f"{as_text(plain_name)}  ECE {one.expected_calibration_error:.3f}, "
                f"over-confident by {one.overconfidence:+.3f}",
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
