"""`vplog optimize`: a pose graph of any origin is read, checked, solved, compared with its odometry, and written."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from vplog.data import Bools, Ints, PoseGraph, Solution
from vplog.errors import GraphError, plural
from vplog.execution.timing import StageTimer
from vplog.geometry.se3 import inverse
from vplog.graph.build import AXES, checked, informed, parts, subgraph
from vplog.graph.certificate import solve_certified
from vplog.graph.consistency import OdometryChain, is_loop, residual_sigma, residual_twists
from vplog.graph.factors import Factors
from vplog.graph.lm import LmSettings, solve_weighted
from vplog.graph.solve import GncSettings, OptimiserSettings, about_slips, decided
from vplog.graph.variance_components import Sigmas
from vplog.results.g2o import GraphFile, read_g2o, write_g2o

_RESTATED, _RESTATED_SIGMA = 1e-3, 1e-2
"""m and rad, and sigma, within which an edge measures what the odometry does: poses that were rounded for a file. Two
measurements by themselves are as near only by chance."""
_AS_CLAIMED = 2.0
"""Factor of a sigma up to which noise is as claimed."""
_CLAIMS = 1e-5, 1e3
"""Standard deviation of odometry, as a share of its steps, that a sensor may have: a thousandth of a per cent of the
path is beyond any sensor, and a thousand times the path is no measurement."""


@dataclass(frozen=True, eq=False)
class Optimised:
    """A solved file."""

    file: GraphFile
    solution: Solution
    record: dict[str, Any]
    """Output of `--json`."""


def optimize(path: Path, out: Path, method: str = "gnc", certify: bool = False) -> Optimised:
    """Solve the graph of a g2o file and write it with its new poses to `out`, all its edges too.

    The poses are the least squares of the edges accepted with the information of the file, as g2o and GTSAM have them;
    closures are judged by the noise that they imply, which the record has as `sigmas` of each part.

    Parts that no edge joins are solved each by itself. The pose that FIX names, else the first of each part, stays
    where it is. With `certify` the record has a `certificate`: whether the solution is the global optimum of the
    accepted edges. If the check finds better poses on its way, these are returned.

    Raises GraphError where the graph cannot be read or solved, ResultError where `out` cannot be written.
    """
    optimiser = TypeAdapter(OptimiserSettings).validate_python({"kind": method})
    watch = StageTimer()
    with watch.stage("read"):
        file = read_g2o(path)
    graph, ids = file.graph, file.ids
    part = parts(len(ids), graph.a, graph.b)
    warnings = file.warnings + _about_parts(part, ids)
    with watch.stage("solve"):
        solution, graph, sigmas, repairs = solve_parts(graph, part, optimiser, ids)
    certificate = None
    if certify:
        with watch.stage("certify"):
            solution, certificate = solve_certified(graph, solution)
    with watch.stage("write"):
        solution = _with_fixed(solution, graph, part == part[file.held], file.held)
        write_g2o(out, file.graph, solution.world_from_body, ids, file.held)
    warnings += repairs + _about_rejected(graph, solution, part, ids)
    record = _record(path, out, method, file, solution, warnings, watch) | {"sigmas": [one._asdict() for one in sigmas]}
    if certificate is not None:
        record["certificate"] = certificate.record()
    return Optimised(file, solution, record)


def _about_parts(part: Ints, ids: Ints) -> list[str]:
    """Warnings on a graph of several unconnected parts (N,)."""
    size = np.bincount(part)
    first = [str(ids[np.argmax(part == number)]) for number in np.flatnonzero(size > 1)[:5].tolist()]
    alone = int((size == 1).sum())
    warnings = [f"{plural(alone, 'pose')} without an edge: left where the file has them."] if alone else []
    if (size > 1).sum() > 1:
        warnings.append(
            f"The graph has {int((size > 1).sum())} unconnected parts (from {', '.join(first)} "
            f"on{', ..' if (size > 1).sum() > 5 else ''}); each is solved by itself with its first pose fixed."
        )
    return warnings


def _about_rejected(graph: PoseGraph, solution: Solution, part: Ints, ids: Ints) -> list[str]:
    """A warning where rejected edges alone join some of a part (N,)."""
    used = solution.weight >= 0.5
    first = np.unique(parts(len(ids), graph.a[used], graph.b[used]), return_index=True)[1]
    alone = ids[np.setdiff1d(first, np.unique(part, return_index=True)[1])]
    if not len(alone):
        return []
    return [
        f"Only rejected edges join {plural(len(alone), 'part')} (from {', '.join(map(str, alone[:5].tolist()))} "
        f"on{', ..' if len(alone) > 5 else ''}) to the others: poses of one are not known relative to those of another."
    ]


def solve_parts(
    graph: PoseGraph, part: Ints, optimiser: OptimiserSettings, ids: Ints
) -> tuple[Solution, PoseGraph, list[Sigmas], list[str]]:
    """The solution of each part (N,) of a graph by itself, put together, the graph as repaired, factors of the claimed
    sigmas in each part, and warnings."""
    poses, weight, information = np.array(graph.world_from_body), np.ones(len(graph.a)), np.array(graph.information)
    solutions, sigmas, warnings = [], list[Sigmas](), []
    size = np.bincount(part)
    of_part = zip(_by_part(part, len(size)), _by_part(part[graph.a], len(size)), strict=True)
    for rows, edges in of_part:
        if len(rows) == 1:
            continue
        alone, repairs = checked(subgraph(graph, rows, edges))
        where = f"Part from {ids[rows[0]]} on: " if (size > 1).sum() > 1 else ""
        if isinstance(optimiser, GncSettings):
            _check_claims(alone)
        again, own = _restates_odometry(alone), np.ones(len(edges))
        judged = np.flatnonzero(~again)
        decision = decided(subgraph(alone, np.arange(len(rows)), judged), optimiser)
        solution, own[judged] = decision.solution, decision.solution.weight
        sigmas.append(decision.sigmas)
        repairs = [*repairs, *_about_noise(decision.sigmas), *about_slips(decision, ids[rows])]
        if again.any():
            found = plural(int(again.sum()), "edge")
            repairs = [*repairs, f"Accepted without being judged, as they restate the odometry: {found}."]
            settings, reason = LmSettings(), solution.reason
            solution = solve_weighted(
                Factors.of(alone), own, solution.world_from_body, settings.max_iterations, settings.tolerance, ""
            )
            solution = replace(solution, reason=reason)
        warnings += [where + text for text in repairs]
        poses[rows], weight[edges], information[edges] = solution.world_from_body, own, alone.information
        solutions.append(replace(solution, reason=where + solution.reason))
    if not solutions:
        raise GraphError(
            "No edge joins two poses, so there is nothing to solve. Give a graph with edges between two poses."
        )
    before, after = (sum(getattr(one, f"error_{when}") for one in solutions) for when in ("before", "after"))
    iterations, converged = max(one.iterations for one in solutions), all(one.converged for one in solutions)
    reason = " ".join(one.reason for one in solutions)
    solution = Solution(poses, weight, before, after, iterations, converged, reason)
    return solution, replace(graph, information=information), sigmas, warnings


def _check_claims(graph: PoseGraph) -> None:
    """Raise GraphError if no odometry has the noise that the information claims: closures cannot be judged by it."""
    edges = np.flatnonzero(graph.odometry)
    step = float(np.sqrt((graph.a_from_b[edges, :3, 3] ** 2).sum(1).mean())) if len(edges) else 0.0
    if not (step and is_loop(graph).any()):
        return
    axes = np.array(AXES[graph.dimension]) >= 3
    variance = np.diagonal(np.linalg.inv(informed(graph, edges)), axis1=1, axis2=2)[:, axes]
    sigma = float(np.sqrt(np.median(variance)))
    if not _CLAIMS[0] <= sigma / step <= _CLAIMS[1]:
        raise GraphError(
            f"The information of the odometry claims a standard deviation of {sigma:.3g} m for steps of {step:.3g} m, "
            "by which closures cannot be judged. Correct the information in the file, or use all edges as they are: "
            "--method lm"
        )


def _about_noise(sigmas: Sigmas) -> list[str]:
    """A warning where the information of the file is not that of the noise found."""
    if not sigmas.differ(Sigmas(), float(np.log(_AS_CLAIMED))):
        return []
    return [
        f"The noise is not as the information claims: sigma of the odometry is {sigmas.rotation:.3g} times that in "
        f"rotation and {sigmas.translation:.3g} in translation, of closures {sigmas.closure_rotation:.3g} and "
        f"{sigmas.closure_translation:.3g}. Poses are solved as claimed; divide the information by the squares for "
        "better ones."
    ]


def _restates_odometry(graph: PoseGraph) -> Bools:
    """(E,) edges but odometry that are computed from the odometry's poses, as those of covisibility graphs are: no
    measurement of their own, they would have the odometry taken for as good as they agree with it."""
    chain, edges = OdometryChain.of(graph), np.arange(len(graph.a))
    off = np.abs(residual_twists(graph, chain.poses, edges)).max(1)
    same = (off < _RESTATED) & (residual_sigma(graph, chain.poses) < _RESTATED_SIGMA)
    return ~graph.odometry & same & (chain.part[graph.a] == chain.part[graph.b])


def _by_part(part: Ints, parts: int) -> list[Ints]:
    """The rows of each part, in order, of the part that each row (N,) is of."""
    return np.split(np.argsort(part, kind="stable"), np.cumsum(np.bincount(part, minlength=parts))[:-1])


def _with_fixed(solution: Solution, graph: PoseGraph, part: np.ndarray, row: int) -> Solution:
    """The solution with this part (N,) moved as one so that its row is where the graph has it."""
    poses = np.array(solution.world_from_body)
    poses[part] = graph.world_from_body[row] @ inverse(poses[row]) @ poses[part]
    return replace(solution, world_from_body=poses)


def _record(
    path: Path, out: Path, method: str, file: GraphFile, solution: Solution, warnings: list[str], watch: StageTimer
) -> dict[str, Any]:
    graph = file.graph
    loop = ~graph.odometry
    rejected = np.flatnonzero(solution.weight < 0.5)
    return {
        "graph": str(path),
        "output": str(out),
        "method": method,
        "dimension": graph.dimension,
        "poses": len(file.ids),
        "edges": len(graph.a),
        "odometry": int(graph.odometry.sum()),
        "loops": int(loop.sum()),
        "kept": int(loop.sum()) - len(rejected),
        "rejected": len(rejected),
        "rejected_edges": np.stack([file.ids[graph.a[rejected]], file.ids[graph.b[rejected]]], axis=1).tolist(),
        "error_before": solution.error_before,
        "error_after": solution.error_after,
        "iterations": solution.iterations,
        "converged": solution.converged,
        "odometry_kept": "Odometry was kept" in solution.reason,
        "reason": solution.reason,
        "seconds": {name: round(stage["seconds"], 3) for name, stage in watch.stages.items()},
        "warnings": warnings,
    }
