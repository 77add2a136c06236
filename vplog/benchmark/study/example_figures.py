"""Pictures of what boxes are: on which references, where, and how they move. One function each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.benchmark.study.evaluation_store import Bench
from vplog.benchmark.study.experiments import StudyOptions, box_methods
from vplog.benchmark.study.score_charts import explain
from vplog.data import Boxes, Bytes, Floats, Ints
from vplog.run.figures.canvas import as_text, saved_figure
from vplog.stages import BoxState

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN = 4
"""References drawn for an example, and of the most and least used: the paper's J, and its number in Fig. 9."""
_FRAMES = 12
"""Consecutive frames of Fig. 7: as many as fit side by side and have distinct colours."""
_MOST_EXAMPLES = 6
"""Pairs of drives that examples are drawn of: all pairs of three drives."""
_CLOSE_UP = 10
"""References in the close-up of Fig. 7, as in the paper."""


def references(bench: Bench, options: StudyOptions, out: Path) -> tuple[dict[str, Any], list[str]]:
    """Fig. 9: how often each reference of the first drive explains a frame of any drive."""
    name, state = _learned(bench, options, 0)
    on: list[list[Floats]] = [[] for _ in state.references]
    images = 0
    total = sum(len(frames) for frames in bench.frames)
    for drive in range(len(bench.names)):
        for place in bench.describe(state, drive, "references", images, total).values:
            found = state.boxes(place)
            for reference, corners in zip(found.references.tolist(), found.corners, strict=True):
                on[reference].append(corners)
            images += 1
    count = np.array([len(boxes) for boxes in on])
    order = np.argsort(-count, kind="stable")  # most used first
    rest = float(count[order[len(order) // 2 :]].mean())
    ratio = round(float(count[order[0]]) / rest, 2) if rest else None
    _draw_references(bench, state, name, order, on, images, out)
    about = {
        "method": name,
        "library": bench.names[0],
        "images": images,
        "chosen": {str(reference): int(count[reference]) for reference in order.tolist()},
        "most_against_mean_of_least_half": ratio,
    }
    return about, ["references"]


def examples(bench: Bench, options: StudyOptions, out: Path) -> tuple[dict[str, Any], list[str]]:
    """Fig. 4: a frame that is found and one that is missed of every pair, each with the true frame of the map, and the
    missed one with the answer given."""
    rows, files = [], []
    shown = bench.pairs[:_MOST_EXAMPLES]
    done, total = 0, sum(len(bench.frames[query]) + len(bench.frames[other]) for query, other in shown)
    for query, other in shown:
        name, state = _learned(bench, options, other)
        places = {}
        for drive in sorted({query, other}):
            places[drive] = bench.describe(state, drive, "examples", done, total)
            done += len(bench.frames[drive])
        ranks, truth = bench.rank(state, query, other, places)
        for kind, right in (("found", True), ("missed", False)):
            is_of_kind = (ranks.top_true == 1.0) if right else ranks.true_given & (ranks.better > 0)
            among = np.flatnonzero(ranks.positive & is_of_kind)
            if not len(among):
                continue
            by_rank = np.argsort(ranks.top_score[among] if right else ranks.better[among], kind="stable")
            row = int(among[by_rank[len(among) // 2]])
            true = np.intersect1d(truth.rows(row), places[other].rows)
            answer = int(ranks.top_row[row])
            match = answer if right else int(true[len(true) // 2])
            file = f"examples-{len(files) + 1:02d}-{kind}"
            outcome = f"{kind}: the true frame is no. {int(ranks.better[row]) + 1} of {int(ranks.candidates[row])}"
            sides = {
                "query": (query, row, places[query][row]),
                "true map frame": (other, match, places[other][match]),
            }
            mine, theirs = (state.boxes(place).references for _, _, place in sides.values())
            if not right:
                sides["answer"] = other, answer, places[other][answer]
            _draw_example(bench, state, sides, outcome, file, out)
            files.append(file)
            rows.append(
                {
                    "method": name,
                    "query": bench.names[query],
                    "map": bench.names[other],
                    "kind": kind,
                    "query_frame": int(bench.traversal(query).frames[row]),
                    "map_frame": int(bench.traversal(other).frames[match]),
                    "answer_frame": int(bench.traversal(other).frames[answer]),
                    "rank": int(ranks.better[row]),
                    "shared_references": len(np.intersect1d(mine, theirs)),
                    "figure": f"{file}.png",
                }
            )
    return {"rows": rows}, files


def sequence(bench: Bench, options: StudyOptions, out: Path) -> tuple[dict[str, Any], list[str]]:
    """Fig. 7: the boxes of consecutive frames of the first query, explained by the first map's library."""
    query, other = bench.pairs[0]
    name, state = _learned(bench, options, other)
    places = bench.describe(state, query, "sequence", 0, len(bench.frames[query]))
    found = [state.boxes(place) for place in places.values]
    length = min(_FRAMES, len(found))
    # the run whose frames agree most on three references: Fig. 7 is about what boxes tell where the numbers do not
    agreed = []
    for start in range(len(found) - length + 1):
        used = np.bincount(np.concatenate([one.references for one in found[start : start + length]] or [[0]]))
        agreed.append(int(np.sort(used)[-3:].sum()))
    start = int(np.argmax(agreed))
    run = found[start : start + length]
    used = np.bincount(np.concatenate([one.references for one in run]), minlength=len(state.references))
    order = [int(r) for r in np.argsort(-used, kind="stable") if used[r]]
    rows = places.rows[start : start + length].tolist()
    _draw_sequence(bench, state, rows, run, order, out)
    about = {
        "method": name,
        "query": bench.names[query],
        "library": bench.names[other],
        "frames": [int(bench.traversal(query).frames[row]) for row in rows],
        "references": {str(reference): int(used[reference]) for reference in order},
    }
    return about, ["sequence"]


PICTURES: dict[str, Callable[[Bench, StudyOptions, Path], tuple[dict[str, Any], list[str]]]] = {
    "references": references,
    "examples": examples,
    "sequence": sequence,
}
"""Experiments by name: the record of each for study.json, and the names of its figures."""


def _learned(bench: Bench, options: StudyOptions, drive: int) -> tuple[str, BoxState]:
    """The first method that makes boxes, with the drive's first library."""
    name = box_methods(bench, options)[0]
    state: Any = bench.learn(name, options.libraries(drive)[0])
    return name, state


def _draw_references(
    bench: Bench, state: BoxState, method: str, order: Ints, on: list[list[Floats]], images: int, out: Path
) -> None:
    """The references in `order`, most used first; `on` are the boxes (I, 4) on each, of each image it explains."""
    count = np.array([len(boxes) for boxes in on])
    shown = min(_SHOWN, len(order) // 2)
    with saved_figure(out, "references", 11.0, 6.9) as figure:
        grid = figure.add_gridspec(3, max(shown, 1), height_ratios=(1.25, 1, 1))
        bars = figure.add_subplot(grid[0, :])
        share = 100.0 * count[order] / images
        colours = np.full(len(order), "#b8b8b8", object)
        colours[:shown], colours[len(order) - shown :] = "#d62728", "#1f77b4"
        bars.bar(np.arange(len(order)), share, 0.85, color=colours.tolist())
        bars.axhline(float(share[len(order) // 2 :].mean()), color="#1f77b4", linestyle=":", linewidth=1)
        bars.annotate("mean of the less used half", (len(order) - 1, float(share[len(order) // 2 :].mean())), (0, 3),
                      textcoords="offset points", ha="right", fontsize=8, color="#1f77b4")  # fmt: skip
        bars.set(
            xlabel="reference images, most used first", ylabel="% of images explained", xlim=(-0.7, len(order) - 0.3)
        )
        for line, (rows, colour, word) in enumerate(
            ((order[:shown], "#d62728", "most used"), (order[len(order) - shown :], "#1f77b4", "least used"))
        ):
            for column, reference in enumerate(rows.tolist()):
                axes = figure.add_subplot(grid[1 + line, column])
                _show(axes, state.references[reference].image)
                corners = np.concatenate(on[reference]) if on[reference] else np.zeros((0, 4))
                corners = corners[~np.isnan(corners).any(axis=-1)]
                _overlay(axes, _coverage(corners))
                kinds, often = np.unique(corners, axis=0, return_counts=True)
                for box, times in zip(kinds, often, strict=True):
                    alpha = max(float(times) / int(often.max()), 0.06)
                    _box(axes, box, colour, alpha=alpha, width=1.0)
                text = f"{word}: {count[reference]} of {images} images, {len(corners)} boxes"
                axes.set_title(text, fontsize=8, color=colour)
        explain(
            figure,
            "Which reference images explain the drives",
            f"How often {method} chose each of {len(order)} reference images of {bench.names[0]} to explain a frame of "
            f"any drive ({', '.join(bench.names)}). Below, the most and the least used ones with all boxes that were "
            "mined on them: bright where most boxes are, the stronger a line the more images share that box.",
        )


def _draw_example(
    bench: Bench, state: BoxState, sides: dict[str, tuple[int, int, Any]], outcome: str, file: str, out: Path
) -> None:
    """Rows of a picture: drive, frame and descriptor by role, the query first and the true frame second."""
    query, match, *_ = sides.values()
    mine, other = state.boxes(query[2]), state.boxes(match[2])
    # the query's best references, those that the true frame has too first: there Eq. (1) compares boxes
    both = set(other.references.tolist())
    chosen = sorted(range(len(mine.references)), key=lambda j: (int(mine.references[j]) not in both, j))[:_SHOWN]
    chosen.sort()
    answered = ", below them the answer given" if "answer" in sides else ""
    with saved_figure(out, file, 2.6 * (1 + max(len(chosen), 1)), 0.5 + 1.9 * len(sides)) as figure:
        grid = figure.subplots(len(sides), 1 + max(len(chosen), 1), squeeze=False)
        for line, (role, (drive, row, place)) in enumerate(sides.items()):
            axes, boxes = grid[line, 0], state.boxes(place)
            _show(axes, bench.images(drive, [row])[0])
            _windows(axes, state.windows(0))
            axes.set_title(
                as_text(f"{role}: {bench.names[drive]}, frame {int(bench.traversal(drive).frames[row])}"), fontsize=8.5
            )
            features = bench.traversal(drive).features(row)
            for column, j in enumerate(chosen, start=1):
                reference = int(mine.references[j])
                _show(grid[line, column], state.references[reference].image)
                _overlay(grid[line, column], *state.voting_maps(features, [reference]))
                rank = np.flatnonzero(boxes.references == reference)
                if len(rank):
                    _coloured(grid[line, column], boxes.corners[rank[0]])
                    text = f"reference {reference}, no. {int(rank[0]) + 1} of {role.split()[-1]}"
                else:
                    itself = state.references[reference].stamp_ns == int(bench.traversal(drive).stamp_ns[row])
                    text = f"reference {reference}, {'this very frame' if itself else 'not chosen'}"
                grid[line, column].set_title(text, fontsize=8.5, color="black" if len(rank) else "#999999")
        explain(
            figure,
            f"{bench.names[query[0]]} in {bench.names[match[0]]}, {outcome}",
            f"Left: a query and the frame of the map that shows the same place{answered}, with the middles of the "
            "windows. Right: reference images that explain the query, with the votes of all features of the frame at "
            "the left (bright: many) and, in the colour of each window, the box it is found in. The same place: the "
            "same references, and boxes of one colour in one spot. A frame of the library is explained by itself "
            "first.",
        )


def _draw_sequence(
    bench: Bench, state: BoxState, rows: list[int], run: list[Boxes], order: list[int], out: Path
) -> None:
    from matplotlib import colormaps
    from matplotlib.patches import Rectangle

    query, other = bench.pairs[0]
    colours = [colormaps["plasma"](0.92 * number / max(len(rows) - 1, 1)) for number in range(len(rows))]
    middle = run[0].corners.shape[1] // 2
    with saved_figure(out, "sequence", 12.0, 7.6) as figure:
        parts: Any = figure.subfigures(3, 1, height_ratios=(0.85, 2.1, 2.1))
        strip, plane, below = parts
        for axes, image, row, colour in zip(
            np.atleast_1d(strip.subplots(1, len(rows))), bench.images(query, rows), rows, colours, strict=True
        ):
            _show(axes, image)
            axes.set_title(f"{int(bench.traversal(query).frames[row])}", fontsize=8, color=colour, fontweight="bold")
            for spine in axes.spines.values():
                spine.set(visible=True, color=colour, linewidth=2.5)
        axes = plane.subplots()
        shown = order[:_CLOSE_UP]
        for number, (boxes, colour) in enumerate(zip(run, colours, strict=True)):
            aside = 0.012 * (number - len(run) / 2)  # or the later frame's would hide the earlier one's
            for reference, corners in zip(boxes.references.tolist(), boxes.corners, strict=True):
                if reference not in shown:
                    continue
                left, wide = shown.index(reference) + 0.08, 0.84
                x, y = left + wide * (corners[:, 0] + corners[:, 2]) / 2, (corners[:, 1] + corners[:, 3]) / 2
                axes.plot(x + aside, y + aside / 2, "o", color=colour, markersize=3, markeredgewidth=0, alpha=0.9)
                x0, y0, x1, y1 = corners[middle]
                if not np.isnan(x0):
                    corner = (left + wide * x0 + aside, y0 + aside / 2)
                    box = Rectangle(corner, wide * (x1 - x0), y1 - y0, fill=False, edgecolor=colour, alpha=0.85)
                    axes.add_patch(box)
        axes.set(xlim=(0, len(shown)), ylim=(1, 0), ylabel="height in the reference", yticks=[0, 0.5, 1])
        times = [sum(reference in one.references for one in run) for reference in shown]
        labels = [f"reference {r}\n{t} of {len(rows)} frames" for r, t in zip(shown, times, strict=True)]
        axes.set_xticks(np.arange(len(shown)) + 0.5, labels, fontsize=8)
        axes.vlines(np.arange(1, len(shown)), 0, 1, color="black", linewidth=0.8)
        axes.tick_params(axis="x", length=0)
        close_ups = shown[:3]
        for axes, reference in zip(np.atleast_1d(below.subplots(1, max(len(close_ups), 1))), close_ups, strict=False):
            _show(axes, state.references[reference].image)
            drawn_at: dict[tuple[float, ...], int] = {}
            for boxes, colour in zip(run, colours, strict=True):
                at = np.flatnonzero(boxes.references == reference)
                corners = boxes.corners[int(at[0]), middle] if len(at) else np.full(4, np.nan)
                if not np.isnan(corners).any():
                    _box(axes, _inside(corners, drawn_at), colour, width=1.6)
            axes.set_title(f"reference {reference}: box of the middle window, frame by frame", fontsize=8.5)
        explain(
            figure,
            "Boxes over consecutive frames",
            f"Above: {len(rows)} frames of {bench.names[query]}, each with its colour. Middle: the references of "
            f"{bench.names[other]} that most of them share, each an area of 1 x 1, with the centre of every box and "
            "the outline of the middle window's. Below: the same outlines on three of them. Neighbouring frames share "
            "their references, which alone tell little; the boxes move with the view.",
        )


def _show(axes: Axes, image: Bytes) -> None:
    """The image, in shares of its sides."""
    height, width = image.shape
    axes.imshow(
        image, cmap="gray", vmin=0, vmax=255, interpolation="antialiased", extent=(0, 1, 1, 0), aspect=height / width
    )
    axes.set(xticks=[], yticks=[], xlim=(0, 1), ylim=(1, 0))


def _overlay(axes: Axes, votes: Floats) -> None:
    axes.imshow(
        votes, cmap="inferno", vmin=0, vmax=1, alpha=0.15 + 0.5 * np.sqrt(votes), interpolation="nearest",
        extent=(0, 1, 1, 0), aspect=axes.get_aspect(),
    )  # fmt: skip


def _coverage(corners: Floats) -> Floats:
    """(36, 64) how many of the boxes cover each spot of a reference, 1 the most."""
    x, y = (np.arange(64) + 0.5) / 64, (np.arange(36) + 0.5) / 36
    inside_x = (corners[:, 0, None] <= x) & (x < corners[:, 2, None])
    inside_y = (corners[:, 1, None] <= y) & (y < corners[:, 3, None])
    cover = np.einsum("by,bx->yx", inside_y.astype(np.float64), inside_x.astype(np.float64))
    return cover / max(float(cover.max(initial=0.0)), 1.0)


def _box(axes: Axes, corners: Floats, colour: Any, alpha: float = 1.0, width: float = 1.5) -> None:
    from matplotlib.patches import Rectangle

    x0, y0, x1, y1 = corners
    axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=colour, linewidth=width, alpha=alpha))


def _window_colours(count: int) -> list[Any]:
    from matplotlib import colormaps

    return [colormaps["hsv"](number / count) for number in range(count)]


def _windows(axes: Axes, windows: Floats) -> None:
    """A tile of its colour at the middle of each window, which themselves overlap."""
    for window, colour in zip(windows, _window_colours(len(windows)), strict=True):
        middle, extent = (window[:2] + window[2:]) / 2, (window[2:] - window[:2]) / 6
        _box(axes, np.concatenate([middle - extent, middle + extent]), colour, width=2.2)


def _coloured(axes: Axes, corners: Floats) -> None:
    """Boxes (I, 4) in the colours of their windows; those in one spot are drawn inside each other."""
    drawn_at: dict[tuple[float, ...], int] = {}
    for box, colour in zip(corners, _window_colours(len(corners)), strict=True):
        if not np.isnan(box).any():
            _box(axes, _inside(box, drawn_at), colour)


def _inside(corners: Floats, drawn_at: dict[tuple[float, ...], int]) -> Floats:
    """A little smaller for each box drawn in the same spot before, so that none hides another."""
    times = drawn_at[tuple(corners)] = drawn_at.get(tuple(corners), -1) + 1
    shrink = 0.008 * min(times, 6)
    return corners + np.array([shrink, shrink, -shrink, -shrink])
