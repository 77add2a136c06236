"""Pose graphs of hundreds of thousands of poses: what plain and robust solves take, in time and in memory."""

from __future__ import annotations

import resource
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.benchmarks.graphs import _planar, apart, city, method, spoiled
from tests.benchmarks.measure import Figure
from vplog.data import EdgeKind, PoseGraph
from vplog.geometry import se3
from vplog.graph.consistency import is_loop, odometry_chain

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

LIMIT_S = 7200.0
"""After which a solve is ended."""
FALSE_SHARE = 0.1
"""Of the closures, measured at random before a robust method sees them."""
DRIVES = 20


def large(sizes: Sequence[int], methods: Sequence[str] = ("lm", "gnc")) -> Iterator[Figure]:
    """Seconds of each method on each kind of graph, each in a process of its own so that its memory is its own."""
    for size in sizes:
        for kind in ("city", "drives"):
            for name in methods:
                _, told = apart(_solved, (kind, size, name), LIMIT_S)
                facts = told or {"ended_after_seconds": LIMIT_S}
                what = f"{name} on {size} poses of {kind}: seconds"
                yield Figure(what, facts.get("seconds", float("inf")), None, True, facts)


def _solved(kind: str, poses: int, name: str) -> dict[str, Any]:
    graph = city(poses) if kind == "city" else drives(poses, max(poses // DRIVES, 1))
    false = np.zeros(len(graph.a), bool)
    if name != "lm":
        graph, false = spoiled(graph, FALSE_SHARE, 0)
    method("lm")(drives(1000, 1000))  # what is compiled is not counted
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    began, busy = time.perf_counter(), time.process_time()
    solution = method(name)(graph)
    kept, loop = solution.weight > 0.5, is_loop(graph)
    return {
        "seconds": round(time.perf_counter() - began, 1),
        "cpu_seconds": round(time.process_time() - busy, 1),
        "peak_gb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
        "gb_of_graph": round(before / 2**20, 2),
        "edges": len(graph.a),
        "loops": int(loop.sum()),
        "false": int(false.sum()),
        "false_kept": int((false & kept).sum()),
        "true_rejected": int((loop & ~false & ~kept).sum()),
        "error": solution.error_after,
        "reason": solution.reason,
    }


def drives(poses: int, each: int = 50_000, seed: int = 0) -> PoseGraph:
    """Drives of `each` keyframes 2 m apart over the streets of one hilly city, in space, and closures between passes.

    Streets are 100 m long, and where one was driven before in the same direction, by the same drive or by another,
    every tenth keyframe is a closure. So most poses lie on long chains of odometry. Noise per edge is 2 cm and 0.1
    degrees, of closures 5 cm and 0.3 degrees; each drive starts 5 m and 3 degrees off, as by GPS.
    """
    random = np.random.default_rng(seed)
    along, count = 50, poses // each
    streets = -(-each // along)
    side = max(int(np.sqrt(poses / along / 12.0)), 3)  # each street is driven three times either way
    step = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    true, passes, last = np.empty((count * each, 4, 4)), [], {}
    for drive in range(count):
        corner, heading = random.integers(0, side, 2), 0
        turns = random.choice([0, 0, 1, 3], streets)
        way, headings = np.empty((streets, 2)), np.empty(streets, int)
        for k in range(streets):
            heading = (heading + turns[k]) % 4
            while not ((corner + step[heading] >= 0) & (corner + step[heading] < side)).all():
                heading = (heading + 1) % 4
            way[k], headings[k] = corner, heading
            street, begun = (*corner.tolist(), heading), drive * each + k * along
            if street in last:
                passes.append((last[street], begun))
            last[street] = begun
            corner = corner + step[heading]
        place = (way[:, None] + np.arange(along)[:, None] / along * step[headings][:, None]).reshape(-1, 2)[:each]
        yaw = np.repeat(headings, along)[:each] * np.pi / 2
        flat = _planar(100.0 * place[:, 0], 100.0 * place[:, 1], yaw)
        flat[:, 2, 3] = 10.0 * np.sin(place[:, 0]) + 10.0 * np.cos(0.7 * place[:, 1])
        true[drive * each : (drive + 1) * each] = flat
    begun = np.array(passes)[:, :, None] + np.arange(0, along, 10)
    begun = begun[(begun < np.minimum((begun // each + 1) * each, count * each)).all((1, 2))]
    pairs = np.concatenate([begun[:, 0].ravel(), begun[:, 1].ravel()]).reshape(2, -1)
    chain = np.flatnonzero(np.arange(1, count * each) % each)  # no odometry from one drive to the next
    a, b = np.concatenate([chain, pairs[0]]).astype(np.int32), np.concatenate([chain + 1, pairs[1]]).astype(np.int32)
    loop = np.arange(len(a)) >= len(chain)
    sigma = np.where(loop[:, None], [np.radians(0.3)] * 3 + [0.05] * 3, [np.radians(0.1)] * 3 + [0.02] * 3)
    measured = se3.between(true[a], true[b]) @ se3.exp(random.normal(size=(len(a), 6)) * sigma)
    information = np.zeros((len(a), 6, 6))
    information[:, range(6), range(6)] = sigma**-2.0
    starts = np.repeat(se3.exp(random.normal(size=(count, 6)) * [0, 0, np.radians(3.0), 5.0, 5.0, 0.0]), each, 0)
    kind = [EdgeKind.ODOMETRY] * len(chain) + [EdgeKind.LOOP] * pairs.shape[1]
    graph = PoseGraph(true @ starts, a, b, measured, information, kind, 3)
    return replace(graph, world_from_body=odometry_chain(graph)[0])
