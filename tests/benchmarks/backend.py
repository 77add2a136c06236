"""Pose graph back ends on random worlds: `python -m tests.benchmarks backend [--seeds FIRST:COUNT] [--jobs N]`.

The seeds that decide are drawn by whoever runs it. Each world (worlds.py) is solved by every method (back_ends.py):
vplog as `run` and as `optimize` has it by default, the odometry alone, plain least squares, GTSAM's GNC, Cauchy, DCS
and PCM, least squares on the true closures with the noise as claimed, and an oracle that knows the noise of each
factor, too. The error is the root
mean square distance of positions, after rigid alignment; in worlds with GPS without any, all methods using the fixes
but `optimize`, which has none and is left out there. Told of every method: the share of worlds in which it is more
than 5 % worse than the odometry, with its 95 % interval (Wilson 1927), and of those in which the oracle is not (now and
then odometry is right by luck); the median and the 95th percentile of its error over the oracle's, which is taken to be
2 % of the odometry's at least; true closures lost, of all and in how many worlds more than a fifth; false closures
kept; seconds of the processor, the median and the 95th percentile. Then the same for every method by stratum
(`STRATA`), for vplog by kind of world and by what the log claims wrongly, and vplog's ten worst worlds. The exit status
is 1 if `vplog run` misses a goal, of which one is that no stratum loses 2 % of its true closures. `--seed N` prints one
world with its parameters, `--show` draws it, and `--stratum NAME` draws all worlds from one stratum.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from dataclasses import asdict
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.benchmarks.back_ends import METHODS, answers, odometry, vplog_run
from tests.benchmarks.world_parameters import STRATA
from tests.benchmarks.worlds import Parameters, over_oracle, position_error, score, world
from vplog.geometry import se3

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from tests.benchmarks.back_ends import Answer
    from tests.benchmarks.worlds import World
    from vplog.data import Floats

WORSE = 1.05
"""Times the odometry's error from which a method is worse."""
BELOW = {"worse": 0.01, "lost": 0.02, "kept": 0.005}
"""Goals of `vplog run`: these shares are smaller; that of the true closures lost in every stratum, too."""
AT_MOST = {"median": 1.1, "p95": 1.5}
"""Goals of `vplog run`: the error over the oracle's is no larger."""
OURS = "vplog run"
MOST_LOST = 0.2
"""Share of a world's true closures; losing more counts as a world in which they were lost."""
WORST = 10
Z = 1.96
"""Of the 95 % interval."""


def main(arguments: Sequence[str]) -> int:
    """The exit status: 0 only where every goal is reached, or one world was shown."""
    given = _parser().parse_args(arguments)
    if given.seed is not None:
        _one(given.seed, given.stratum, given.show)
        return 0
    first, count = given.seeds
    rows = []
    for row in measured(range(first, first + count), given.jobs, given.stratum):
        rows.append(row)
        print(f"\r{len(rows)} of {count} worlds", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    report = {"seeds": [first, count], **summary(rows), "worlds": rows}
    print(table(report))
    if given.json is not None:
        given.json.write_text(json.dumps(report, indent=1), encoding="utf-8")
    return 0 if all(reached for _, _, _, reached in _goals(report)) else 1


def _parser() -> argparse.ArgumentParser:
    about = __doc__ or ""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks backend", description=about.split("\n\n")[1])
    parser.add_argument("--seeds", type=_seeds, default=(0, 200), metavar="FIRST:COUNT", help="default 0:200")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--json", type=Path, metavar="FILE", help="all figures, and every world's, as JSON")
    parser.add_argument("--seed", type=int, help="only this world, with its parameters")
    parser.add_argument("--stratum", choices=STRATA, help="only worlds of this stratum (default: all strata)")
    parser.add_argument("--show", nargs="?", type=Path, const=Path(), metavar="PNG", help="draw it (world-SEED.png)")
    return parser


def _seeds(text: str) -> tuple[int, int]:
    first, _, count = text.partition(":")
    return int(first), int(count or 1)


# --- measuring ------------------------------------------------------------------------------------------------------


def measured(seeds: Sequence[int], jobs: int, stratum: str | None) -> Iterator[dict[str, Any]]:
    """The row of each world, in order of seeds, whatever the number of processes."""
    rows = partial(row_of, stratum=stratum)
    if jobs <= 1:
        _start()
        yield from map(rows, seeds)
        return
    with get_context("spawn").Pool(jobs, _start) as pool:
        yield from pool.imap(rows, seeds)


def _start() -> None:
    """What is compiled or loaded first is not counted."""
    logging.getLogger("vplog").addHandler(logging.NullHandler())  # no warnings of a hundred odometries on stderr
    answers(world(0))


def row_of(seed: int, stratum: str | None) -> dict[str, Any]:
    """A world's parameters, and every method's scores."""
    made = world(seed, stratum)
    found = answers(made)
    scores = {name: score(made, answer.poses, answer.kept) for name, (answer, _) in found.items()}
    reference, oracle = scores["odometry"].error_m, scores["oracle"].error_m
    methods = {
        name: {
            **asdict(scores[name]),
            "over_odometry": scores[name].error_m / max(reference, 1e-9),
            "over_oracle": over_oracle(scores[name].error_m, oracle, reference),
            "seconds": seconds,
            "refusal": answer.refusal,
        }
        for name, (answer, seconds) in found.items()
    }
    return {
        "seed": seed,
        "parameters": made.parameters.as_json(),
        "mistold": made.parameters.mistold,
        "falseness": made.parameters.falseness,
        "true": int(made.is_true.sum()),
        "false": int((~made.is_true).sum()),
        "fixes": len(made.fix_row),
        "methods": methods,
    }


# --- figures --------------------------------------------------------------------------------------------------------


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of every method over all worlds, and over those of each kind."""
    groups = {}
    for title, labels in _GROUPS.items():
        names = sorted({label for row in rows for label in labels(row)})
        groups[title] = {name: figures([row for row in rows if name in labels(row)]) for name in names}
    ranked = sorted(rows, key=lambda row: _harm(row["methods"][OURS]), reverse=True)
    return {
        "all": figures(rows),
        "oracle_beats_odometry": float(np.mean([row["methods"]["oracle"]["over_odometry"] <= 1.001 for row in rows])),
        "by": groups,
        "worst": [row["seed"] for row in ranked[:WORST]],
    }


def _harm(one: dict[str, Any]) -> tuple[float, float]:
    """Worse than odometry first, then far from what was possible."""
    return max(one["over_odometry"], WORSE), one["over_oracle"]


_GROUPS: dict[str, Callable[[dict[str, Any]], list[str]]] = {
    "stratum": lambda row: [row["parameters"]["stratum"]],
    "kind": lambda row: [row["parameters"]["kind"]],
    "dimension": lambda row: ["3D" if row["parameters"]["spatial"] else "2D"],
    "false closures": lambda row: [row["falseness"]],
    "odometry claim": lambda row: [row["parameters"]["claim"]],
    "mis-told": lambda row: row["mistold"],
    "gps": lambda row: [row["parameters"]["gps"]],
    "closures": lambda row: ["below 50" if row["true"] < 50 else "50 or more"],
    "drift": lambda row: [_band(row["parameters"]["drift"])],
}


def _band(drift: float) -> str:
    return next(f"below {bound:.1%}" for bound in (0.005, 0.01, 0.02, 0.04, 0.0601) if drift <= bound)


def figures(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Of each method over worlds."""
    return {name: _figures(name, [row for row in rows if name in row["methods"]]) for name in METHODS}


def _figures(name: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    if not rows:
        return {"worlds": 0}
    found = [row["methods"][name] for row in rows]
    worse = sum(one["over_odometry"] > WORSE for one in found)
    oracles = [row["methods"]["oracle"]["over_odometry"] for row in rows]
    avoidable = sum(one["over_odometry"] > WORSE >= best for one, best in zip(found, oracles, strict=True))
    ratio = np.percentile([one["over_oracle"] for one in found], [50, 95])
    seconds = np.percentile([one["seconds"] for one in found], [50, 95])
    lost, true = sum(one["true_lost"] for one in found), sum(row["true"] for row in rows)
    kept, false = sum(one["false_kept"] for one in found), sum(row["false"] for row in rows)
    with_true = [(one, row) for one, row in zip(found, rows, strict=True) if row["true"]]
    many = sum(one["true_lost"] > MOST_LOST * row["true"] for one, row in with_true)
    return {
        "worlds": len(rows),
        "worse": worse / len(rows),
        "worse_interval": wilson(worse, len(rows)),
        "avoidable": avoidable / len(rows),
        "median": float(ratio[0]),
        "p95": float(ratio[1]),
        "lost": lost / max(true, 1),
        "worlds_lost": many / max(len(with_true), 1),
        "kept": kept / max(false, 1),
        "seconds": float(seconds[0]),
        "seconds_p95": float(seconds[1]),
        "refused": sum(bool(one["refusal"]) for one in found),
    }


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share: Wilson, Journal of the American Statistical Association 1927."""
    share = hits / count
    middle = (share + Z**2 / (2 * count)) / (1 + Z**2 / count)
    half = Z / (1 + Z**2 / count) * np.sqrt(share * (1 - share) / count + Z**2 / (4 * count**2))
    return max(float(middle - half), 0.0), min(float(middle + half), 1.0)


def _goals(report: dict[str, Any]) -> list[tuple[str, float, float, bool]]:
    """Name, value, goal and whether it is reached."""
    ours = report["all"][OURS]
    shares = [(name, ours[name], goal) for name, goal in BELOW.items()]
    for stratum, methods in report["by"]["stratum"].items():
        shares.append((f"lost, {stratum}", methods[OURS]["lost"], BELOW["lost"]))
    return [
        *((name, value, goal, value < goal) for name, value, goal in shares),
        *((name, ours[name], goal, ours[name] <= goal) for name, goal in AT_MOST.items()),
    ]


# --- telling --------------------------------------------------------------------------------------------------------

_HEAD = (
    f"{'':<30} {'worlds':>6} {'worse':>6} {'(95 %)':>13} {'avoid.':>6} {'median':>7} {'p95':>7} {'lost':>6} "
    f"{'>1/5':>6} {'false':>6} {'CPU s':>6} {'p95':>6} {'refused':>7}"
)


def table(report: dict[str, Any]) -> str:
    """All methods over all worlds, then vplog beside the odometry and the best peer of each group, then the worst."""
    first, count = report["seeds"]
    beats = report["oracle_beats_odometry"]
    lines = [
        f"{count} worlds from seed {first}; the oracle is no worse than the odometry in {beats:.0%} of them.",
        f"worse: by more than {WORSE - 1:.0%} than the odometry; avoid.: and the oracle is not. median, p95: error",
        "over the oracle's. lost: true closures; >1/5: worlds that lose more than a fifth. false: false closures kept.",
        _HEAD,
        *(_line(name, one) for name, one in report["all"].items()),
        "",
    ]
    for stratum, methods in report["by"]["stratum"].items():
        lines += [f"stratum: {stratum}", *(_line(name, one) for name, one in methods.items()), ""]
    for title, groups in report["by"].items():
        lines += [f"{OURS} by {title}", *(_line(name, methods[OURS]) for name, methods in groups.items()), ""]
    lines += [*_matrix(report), ""]
    lines.append(f"{OURS}: the worst worlds (python -m tests.benchmarks backend --seed N --show)")
    by_seed = {row["seed"]: row for row in report["worlds"]}
    lines += [_world_line(by_seed[seed]) for seed in report["worst"]]
    lines.append("")
    for name, value, goal, reached in _goals(report):
        sign = "<=" if name in AT_MOST else "<"
        lines.append(f"{OURS} {name:<14} {value:8.3g} {sign:>2} {goal:<6g} {'pass' if reached else 'MISSED'}")
    return "\n".join(lines)


def _matrix(report: dict[str, Any]) -> Iterator[str]:
    """Of each group and method the share of worlds worse than the odometry, and the 95th percentile to the oracle."""
    peers = [name for name in report["all"] if name not in ("odometry", "oracle")]
    yield "worse than the odometry / 95th percentile over the oracle"
    yield f"{'':<30}" + "".join(f" {name:>14}" for name in peers)
    for title, groups in report["by"].items():
        for name, methods in groups.items():
            cells = (methods[peer] for peer in peers)
            shown = (f"{one['worse']:.0%} / {one['p95']:.1f}" if one["worlds"] else "-" for one in cells)
            yield f"{f'{title}: {name}'[:30]:<30}" + "".join(f" {cell:>14}" for cell in shown)


def _line(name: str, one: dict[str, Any]) -> str:
    if not one["worlds"]:
        return f"{name:<30} {0:>6}"
    low, high = one["worse_interval"]
    return (
        f"{name:<30} {one['worlds']:>6} {one['worse']:>6.1%} {f'{low:.1%}-{high:.1%}':>13} {one['avoidable']:>6.1%} "
        f"{one['median']:>7.2f} "
        f"{one['p95']:>7.2f} {one['lost']:>6.1%} {one['worlds_lost']:>6.1%} {one['kept']:>6.1%} "
        f"{one['seconds']:>6.2f} {one['seconds_p95']:>6.2f} {one['refused']:>7}"
    )


def _world_line(row: dict[str, Any]) -> str:
    methods = row["methods"]
    errors = ", ".join(f"{name} {one['error_m']:.3g}" for name, one in methods.items())
    return (
        f"{_title(Parameters(**row['parameters']))}\n"
        f"    lost {methods[OURS]['true_lost']} of {row['true']}, false kept {methods[OURS]['false_kept']} of "
        f"{row['false']}; error in m: {errors}"
    )


def _one(seed: int, stratum: str | None, picture: Path | None) -> None:
    """One world in words, and drawn."""
    made = world(seed, stratum)
    for name, value in made.parameters.as_json().items():
        print(f"{name:<18} {value:.6g}" if isinstance(value, float) else f"{name:<18} {value}")
    print(_world_line(row_of(seed, stratum)))
    if picture is not None:
        picture = Path(f"world-{seed}.png") if picture == Path() else picture
        show(made, vplog_run(made), picture)
        print(picture)


def show(made: World, answer: Answer, picture: Path) -> None:
    """Truth, odometry, estimate, and closures by true or false and kept or dropped, from above and from the side."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    def path(points: Floats) -> Floats:
        """With NaN between sessions, so that no line joins them."""
        return np.insert(points, made.breaks + 1, np.nan, axis=0)

    truth, wrong = made.truth[:, :3, 3], np.flatnonzero(made.is_wrong) + 1
    lines = {"odometry": odometry(made).poses[:, :3, 3], OURS: answer.poses[:, :3, 3]}
    if made.gps is None:
        lines = {name: se3.transform(se3.umeyama(line, truth)[0], line) for name, line in lines.items()}
    figure, (above, side) = plt.subplots(1, 2, figsize=(16, 8))
    for axes, (x, y) in ((above, (0, 1)), (side, (0, 2))):
        for is_true, kept, colour, name in _CLOSURES:
            rows = np.flatnonzero((made.is_true == is_true) & (answer.kept == kept))
            ends = np.stack([truth[made.closures.match[rows]], truth[made.closures.query[rows]]], axis=1)
            label = f"{name} ({len(rows)})"
            for k, (one, two) in enumerate(ends):
                axes.plot([one[x], two[x]], [one[y], two[y]], colour, lw=1.0, alpha=0.6, label="" if k else label)
                axes.plot([one[x], two[x]], [one[y], two[y]], ".", color=colour, ms=4)
        axes.plot(*path(truth)[:, [x, y]].T, "k", lw=1.5, label="truth")
        if len(wrong):
            axes.plot(truth[wrong, x], truth[wrong, y], "x", color="tab:pink", ms=5, label=made.parameters.stratum)
        for (name, line), colour in zip(lines.items(), ("tab:gray", "tab:blue"), strict=True):
            error = position_error(line, truth, False)
            axes.plot(*path(line)[:, [x, y]].T, colour, lw=1.0, label=f"{name} ({error:.3g} m)")
        if made.gps is not None:
            axes.plot(made.fix_enu[:, x], made.fix_enu[:, y], "+", color="tab:purple", ms=4, label="fixes")
        axes.set(xlabel="xyz"[x] + " [m]", ylabel="xyz"[y] + " [m]")
    above.set_aspect("equal", "datalim")
    above.legend(fontsize="small")
    figure.suptitle(_title(made.parameters))
    figure.savefig(picture, dpi=80, bbox_inches="tight")
    plt.close(figure)


_CLOSURES = (
    (True, True, "tab:green", "true, kept"),
    (True, False, "tab:orange", "true, dropped"),
    (False, False, "lightgray", "false, dropped"),
    (False, True, "tab:red", "false, kept"),
)


def _title(parameters: Parameters) -> str:
    return (
        f"seed {parameters.seed}: {parameters.kind} ({parameters.layout}), {parameters.stratum}, "
        f"drift {parameters.drift:.1%}, false closures {parameters.falseness}, gps {parameters.gps}\n"
        f"mis-told: {', '.join(parameters.mistold)}"
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
