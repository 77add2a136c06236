"""The curves of a comparison: precision over recall, and recall over rank."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vplog.drawing import as_text, drawn
from vplog.evaluate.retrieval import average_precision, precision_recall, recall_at

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.evaluate.retrieval import Ranks

_DEEPEST_RANK = 25
"""Of the curves: the usual axis of recall@N in place recognition, e.g. Arandjelovic et al., NetVLAD, CVPR 2016."""
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
