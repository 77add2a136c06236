"""Charts of the experiments that are numbers, one function each, drawn from the content of study.json."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.run.figures.canvas import as_text, saved_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    Found = dict[str, Any]

_SHARE, _RANK = "R@1  (more is better)", "ANR in %  (less is better)"
_MOST_COLUMNS = 6
"""Pairs of drives that fit beside each other; of more only the mean is drawn."""
_MOST_BARS = 12
"""Pairs of drives in one chart of bars."""
_METHODS = {
    "bobb": "#d62728",
    "bobb_paper": "#ff9d4d",
    "hybrid": "#8c1a1a",
    "bovf": "#1f77b4",
    "fabmap": "#7b4fb5",
    "vlad": "#2ca02c",
    "gist": "#8c6d4f",
    "thumbnail": "#7f7f7f",
}
"""Warm where boxes are mined, cold where words are counted, dull where whole images are compared."""
_OTHERS = ("#e377c2", "#17becf", "#bcbd22", "#393b79", "#637939", "#843c39")
_DRIVES = ("#4c9f70", "#e0a43a", "#3d5a80", "#b56576", "#6d597a", "#84a59d", "#bc6c25", "#264653")
_CAPTION_PT = 8
_CHARACTERS_AN_INCH = 15.5
"""Characters of a caption line at that size."""


def draw_pairs(found: Found, folder: Path) -> None:
    """Fig. 5."""
    rows = found["rows"]
    methods, labels = _unique(rows, "method"), _pair_labels(rows)[:_MOST_BARS]
    with saved_figure(folder, "pairs", max(7.0, 1.3 + 1.6 * len(labels)), 7.6) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True)
        styles = {method: (colour_of(method, methods), as_text(method)) for method in methods}
        _grouped_bars(
            (upper, lower), rows, labels, "method", styles, lambda row: f"{row['r_at_1']:.2f}".removeprefix("0")
        )
        upper.set(ylabel=_SHARE, ylim=(0, 1.06), xlim=(-0.55, len(labels) - 0.45))
        _rank_axis(lower, [row["anr"] for row in rows], from_zero=True)
        lower.set_xticks(range(len(labels)), [as_text(label) for label in labels])
        upper.legend(ncols=min(len(methods), 8), fontsize=8, loc="lower left", bbox_to_anchor=(0, 1), frameon=False)
        explain(
            figure,
            "Recognition on every pair of drives",
            f"Every frame of one drive is looked for in another, with a library of {rows[0]['size']} random frames of "
            "the map. Bars: mean over library seeds; black lines: to the worst seed. R@1 is the share of frames whose "
            "first answer is right; ANR the mean rank of the true answer in percent of the map, on a logarithmic axis.",
        )


def draw_sizes(found: Found, folder: Path) -> None:
    """Fig. 6."""
    rows = found["rows"]
    methods, sizes = _unique(rows, "method"), sorted(set(_unique(rows, "size")))
    labels = _pair_labels(rows)
    shown = labels if len(labels) <= _MOST_COLUMNS else []
    columns = [*shown, "mean of all pairs"]
    with saved_figure(folder, "sizes", max(6.0, 1.2 + 1.55 * len(columns)), 5.4) as figure:
        grid = figure.subplots(2, len(columns), sharex=True, sharey="row", squeeze=False)
        for column, label in enumerate(columns):
            for method in methods:
                some = [r for r in rows if r["method"] == method and (pair_label(r) == label or label not in shown)]
                for axes, score in ((grid[0, column], "r_at_1"), (grid[1, column], "anr")):
                    mean = [np.mean([r[score] for r in some if r["size"] == size]) for size in sizes]
                    worst = [np.mean([r[f"{score}_worst"] for r in some if r["size"] == size]) for size in sizes]
                    colour = colour_of(method, methods)
                    axes.plot(sizes, mean, "o-", color=colour, label=as_text(method), markersize=4)
                    axes.fill_between(sizes, mean, worst, color=colour, alpha=0.2, linewidth=0)
            grid[0, column].set_title(as_text(label), fontsize=8, fontweight=None if label in shown else "bold")
            grid[1, column].set_xlabel("library size L")
            grid[1, column].set_xscale("log")
            grid[1, column].set_xticks(sizes, [str(size) for size in sizes], fontsize=8)
            grid[1, column].minorticks_off()
            for axes in grid[:, column]:
                axes.grid(alpha=0.3)
        grid[0, 0].set(ylabel=_SHARE, ylim=(0, 1.0))
        _rank_axis(grid[1, 0], [row["anr"] for row in rows])
        figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="upper right", ncols=len(methods), frameon=False)
        explain(
            figure,
            "How many reference images it takes",
            "Recognition against the size of the library, random frames of the map. Lines: mean over library seeds; "
            "shaded: to the worst seed.",
        )


def draw_library(found: Found, folder: Path) -> None:
    """Fig. 8."""
    rows = found["rows"]
    methods, drives = _unique(rows, "method"), _unique(rows, "library")
    drives.sort(key=[row["map"] for row in rows].index)
    labels = _pair_labels(rows)[:_MOST_BARS]
    styles = {drive: (_DRIVES[number % len(_DRIVES)], as_text(f"from {drive}")) for number, drive in enumerate(drives)}
    marks = {"map": "M", "query": "Q"}
    with saved_figure(folder, "library", max(7.0, 1.3 + 1.35 * len(labels)), 1.2 + 2.9 * len(methods)) as figure:
        grid = figure.subplots(2 * len(methods), 1, sharex=True, squeeze=False)[:, 0]
        for pair_of_axes, method in zip(grid.reshape(-1, 2), methods, strict=True):
            some = [row for row in rows if row["method"] == method]
            _grouped_bars(list(pair_of_axes), some, labels, "library", styles, lambda row: marks.get(row["from"], "–"))
            pair_of_axes[0].set(ylabel=f"{as_text(method)}\nR@1", ylim=(0, 1.0))
            _rank_axis(pair_of_axes[1], [row["anr"] for row in rows], from_zero=True)
            pair_of_axes[1].set_ylabel(f"{as_text(method)}\nANR in %")
        grid[-1].set_xticks(range(len(labels)), [as_text(label) for label in labels])
        grid[0].legend(ncols=len(drives), fontsize=8, loc="lower left", bbox_to_anchor=(0, 1), frameon=False)
        explain(
            figure,
            "Which drive the library comes from",
            "The same pairs, explained by reference images of one drive after the other: M the map's own, Q the "
            "query's own, – a drive that is neither. Bars: mean over library seeds; black lines: to the worst seed.",
        )


def draw_conditions(found: Found, folder: Path) -> None:
    """Fig. 10."""
    from matplotlib.colors import LogNorm

    drives, tables = found["drives"], found["query_by_map"]
    side = max(1.45, 0.55 * len(drives))
    width = 1.6 + side * len(tables)
    anr = [v for table in tables.values() for line in table["anr"] for v in line if v is not None]
    with saved_figure(folder, "conditions", max(width, 6.5), 2 * side + 1.9) as figure:
        grid = figure.subplots(2, len(tables), sharex=True, sharey=True, squeeze=False)
        for column, (method, table) in enumerate(tables.items()):
            for axes, score in zip(grid[:, column], ("r_at_1", "anr"), strict=True):
                values = np.array([[np.nan if v is None else v for v in line] for line in table[score]])
                if score == "r_at_1":
                    style: Any = {"cmap": "RdYlGn", "vmin": 0.0, "vmax": 1.0}
                    shown, axes_title = values, as_text(method)
                else:
                    shown = np.maximum(values, 0.1)
                    style = {"cmap": "RdYlGn_r", "norm": LogNorm(max(min(anr), 0.1), max(*anr, 0.2))}
                    axes_title = ""
                axes.imshow(shown, alpha=0.85, **style)
                axes.set_title(axes_title, fontsize=9, fontweight="bold")
                axes.set_facecolor("#eeeeee")
                for (q, m), value in np.ndenumerate(values):
                    digits = 2 if score == "r_at_1" or value < 1 else 1
                    text = "" if np.isnan(value) else f"{value:.{digits}f}"
                    axes.text(m, q, text, ha="center", va="center", fontsize=8)
                axes.set_xticks(range(len(drives)), [as_text(d) for d in drives], rotation=40, ha="right", fontsize=8)
                axes.set_yticks(range(len(drives)), [as_text(d) for d in drives], fontsize=8)
                axes.tick_params(length=0)
        grid[0, 0].set_ylabel("R@1\nquery")
        grid[1, 0].set_ylabel("ANR in %\nquery")
        for axes in grid[1]:
            axes.set_xlabel("map", fontsize=8)
        explain(
            figure,
            "Change of condition",
            "Condition of the query (rows) against condition of the map (columns), a table for each method; the "
            "library comes from the map. Above: share of frames found at once. Below: mean rank of the true frame in "
            "percent of the map. Green is good.",
        )


def draw_bits(found: Found, folder: Path) -> None:
    """The spatial cost of section IV, as one chart."""
    rows = found["rows"]
    methods = [row["method"] for row in rows]
    with saved_figure(folder, "bits", 10.0, 5.0) as figure:
        grid = figure.subplots(1, 2)
        for axes, score in zip(grid, ("r_at_1", "anr"), strict=True):
            for row in rows:
                colour = colour_of(row["method"], methods)
                stored, packed = row["stored_bits"], row["packed_bits"]
                if packed < stored:
                    axes.plot([packed, stored], [row[score]] * 2, ":", color=colour)
                    axes.plot(packed, row[score], "o", markersize=9, markerfacecolor="white", color=colour)
                axes.plot(stored, row[score], "o", markersize=9, color=colour)
            axes.set_xscale("log")
            low, high = min(r["packed_bits"] for r in rows), max(r["stored_bits"] for r in rows)
            axes.set(xlabel="bits per image", xlim=(low / 2.2, high * 3.5))
            axes.grid(alpha=0.3)
        grid[0].set(ylabel=_SHARE, ylim=(0, 1.0))
        _rank_axis(grid[1], [row["anr"] for row in rows])
        for axes, score in zip(grid, ("r_at_1", "anr"), strict=True):
            _label_points(axes, rows, score)
        explain(
            figure,
            "What a place takes, and what it is worth",
            "Mean of all pairs and library seeds against the size of a stored place, on a logarithmic axis. Hollow: "
            "the size when the numbers of references and boxes are packed without a gap, as the paper counts them.",
        )


def draw_ablations(found: Found, folder: Path) -> None:
    """One bar for each ablation: the change of the score."""
    rows, base = found["rows"], found["base"]
    order = sorted(rows, key=lambda row: -row["r_at_1_change"])
    at = np.arange(len(order))
    with saved_figure(folder, "ablations", 10.5, 1.9 + 0.36 * len(order)) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        for axes, score, sign in ((left, "r_at_1", 1), (right, "anr", -1)):
            change = np.array([row[f"{score}_change"] for row in order])
            axes.barh(at, change, 0.68, color=["#b5413b" if sign * c < 0 else "#4c9f70" for c in change], alpha=0.75)
            for y, row in zip(at, order, strict=True):
                each = [one[score] for one in row["changes"]]
                axes.plot(each, [y] * len(each), "|", color="#333333", markersize=7, alpha=0.8)
            axes.axvline(0, color="black", linewidth=0.8)
            axes.grid(alpha=0.3, axis="x")
            widest = max((abs(one[score]) for row in order for one in row["changes"]), default=0.0) or 0.1
            axes.set_xlim(-1.35 * widest, 1.35 * widest)
            for y, value in zip(at, change, strict=True):
                axes.annotate(f"{value:+.3f}" if score == "r_at_1" else f"{value:+.2f}", (1.0, y), (-4, 0), va="center",
                              ha="right", fontsize=7.5, xycoords=("axes fraction", "data"),
                              textcoords="offset points")  # fmt: skip
        left.set_yticks(at, [f"{as_text(row['name'])}  ({as_text(row['setting'])})" for row in order], fontsize=8.5)
        left.set_xlabel(f"change of R@1, from {base['r_at_1']:.3f}")
        right.set_xlabel(f"change of ANR in points, from {base['anr']:.2f} %")
        explain(
            figure,
            "What each departure from the paper is worth",
            "bobb with one idea taken back at a time, the same features and libraries. Bars and numbers: mean of all "
            "pairs and seeds; ticks: each pair. Red is worse without the idea, green better.",
        )


CHARTS = {
    "pairs": draw_pairs,
    "sizes": draw_sizes,
    "library": draw_library,
    "conditions": draw_conditions,
    "bits": draw_bits,
    "ablations": draw_ablations,
}
"""Drawing function of each experiment."""


def _unique(rows: list[Found], name: str) -> list[Any]:
    return list(dict.fromkeys(row[name] for row in rows))


def _pair_labels(rows: list[Found]) -> list[str]:
    return list(dict.fromkeys(pair_label(row) for row in rows))


def _grouped_bars(
    axes: Sequence[Axes],
    rows: list[Found],
    labels: list[str],
    by: str,
    styles: dict[str, tuple[str, str]],
    mark: Callable[[Found], str],
) -> None:
    """R@1 and ANR on axes of their own: for each pair of drives a bar for every value of the column `by`, with its
    colour and label in `styles`. Bars are means over seeds, with a line to the worst and a mark above R@1."""
    wide = 0.82 / len(styles)
    for number, (value, (colour, name)) in enumerate(styles.items()):
        at = np.arange(len(labels)) + (number - (len(styles) - 1) / 2) * wide
        found = {pair_label(row): row for row in rows if row[by] == value}
        some = [found[label] for label in labels]
        for one, score in zip(axes, ("r_at_1", "anr"), strict=True):
            mean = np.array([row[score] for row in some])
            one.bar(at, mean, 0.92 * wide, color=colour, label=name)
            one.vlines(at, mean, [row[f"{score}_worst"] for row in some], color="black", linewidth=1.0)
        for x, row in zip(at, some, strict=True):
            axes[0].annotate(mark(row), (x, row["r_at_1"]), (0, 2), textcoords="offset points", ha="center",
                             fontsize=6, color="#333333")  # fmt: skip


def _rank_axis(axes: Axes, values: list[float], from_zero: bool = False) -> None:
    """A logarithmic axis of ANR that begins and ends at a round number; bars begin at zero."""
    from matplotlib.ticker import NullLocator

    ticks = [0, 0.1, 0.3, 1, 3, 10, 30, 100]
    top = next(tick for tick in ticks if tick >= min(max(*values, 0.3) * 1.15, 100))
    low = 0 if from_zero else max(tick for tick in ticks[:-2] if tick <= min(values) * 0.87)
    axes.set_yscale("symlog", linthresh=0.1, linscale=0.4)
    axes.set(ylim=(low, top), ylabel=_RANK)
    shown = [tick for tick in ticks if low <= tick <= top]
    axes.set_yticks(shown, [f"{tick:g}" for tick in shown])
    axes.yaxis.set_minor_locator(NullLocator())
    axes.grid(alpha=0.3, axis="y")
    axes.set_axisbelow(True)


def _label_points(axes: Axes, rows: list[Found], score: str) -> None:
    """A name right of each point; where another point or name would be in the way, left of it, or above its line."""
    at = axes.transData.transform([(row["stored_bits"], row[score]) for row in rows])
    for number, row in enumerate(rows):
        right, up = (at - at[number]).T
        crowded = np.any((right > 0) & (right < 75) & (np.abs(up) < 14))  # px at 100 a inch: a name is that long
        place: dict[str, Any] = {"xytext": (9, 0), "ha": "left", "va": "center"}
        if crowded and row["packed_bits"] < row["stored_bits"]:
            place = {"xytext": (0, 8), "ha": "right", "va": "bottom"}
        elif crowded:
            place = {"xytext": (-9, 0), "ha": "right", "va": "center"}
        axes.annotate(
            as_text(row["method"]), (row["stored_bits"], row[score]), textcoords="offset points", fontsize=9, **place
        )


def colour_of(method: str, methods: Sequence[str]) -> str:
    """A recogniser's own colour; methods with settings get one by their place in the list."""
    if method in _METHODS:
        return _METHODS[method]
    return _OTHERS[[name for name in methods if name not in _METHODS].index(method) % len(_OTHERS)]


def pair_label(row: dict[str, Any]) -> str:
    """`query in map`, on two lines."""
    return f"{row['query']}\nin {row['map']}" if row["query"] != row["map"] else f"{row['query']}\nin its past"


def explain(figure: Figure, title: str, caption: str) -> None:
    """A title above, and below it all what is seen."""
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
    lines = textwrap.fill(caption, int(figure.get_figwidth() * _CHARACTERS_AN_INCH))
    figure.supxlabel(lines, x=0.01, ha="left", fontsize=_CAPTION_PT, color="#444444")
