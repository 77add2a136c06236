"""From what drives and their ledgers hold to the joint graph of several, and back."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vplog.back_end import by_odometry
from vplog.data import EdgeKind, Verdict
from vplog.graph import joint as graph_joint
from vplog.graph.build import busier
from vplog.graph.refine import rescaled

if TYPE_CHECKING:
    from vplog.data import Closures, Floats, PoseGraph


def own_drive(graph: PoseGraph, weight: Floats, closures: Closures, sigma_factor: float) -> graph_joint.Drive:
    """A drive's graph, at its solved poses, without the closures that its own solve rejected (`weight` (E,) 0), with
    the odometry's noise as it was said: `sigma_factor` is what the solve made of it.

    The metres stay as they were found: with the same noise for all, the joint solve judges it anew.
    """
    odometry = np.array([kind == EdgeKind.ODOMETRY for kind in graph.kind], bool)
    said = rescaled(graph, odometry, odometry, 1.0 / sigma_factor**2, 1.0)
    used = np.flatnonzero(np.isfinite(closures.weight))
    metric = np.array([closures.scale[row] != "none" for row in used.tolist()], bool)
    of_odometry = by_odometry(said, closures, np.concatenate([used[metric], used[~metric]]))
    kept = np.flatnonzero(odometry | (weight > 0.5))
    own = replace(
        said,
        a=graph.a[kept],
        b=graph.b[kept],
        a_from_b=said.a_from_b[kept],
        information=said.information[kept],
        kind=[graph.kind[edge] for edge in kept.tolist()],
    )
    return graph_joint.Drive(own, of_odometry[kept], sigma_factor)


def between_of(later: int, earlier: int, ledger: Closures) -> graph_joint.Between:
    """The verified closures of a ledger, for the graph."""
    rows = np.flatnonzero([verdict is Verdict.ACCEPTED for verdict in ledger.verdict])
    shared = busier(ledger.match[rows], ledger.query[rows])
    return graph_joint.Between(
        later,
        earlier,
        query=ledger.query[rows].astype(np.int64),
        match=ledger.match[rows].astype(np.int64),
        match_from_query=ledger.match_from_query[rows],
        information=ledger.information[rows] / shared[:, None, None],
        of_odometry=np.array([ledger.scale[row] == "odometry" for row in rows.tolist()], bool),
    )


def judged_by(ledger: Closures, weight: Floats, residual: Floats) -> Closures:
    """The ledger with what the joint solve made of its verified rows."""
    rows = np.flatnonzero([verdict is Verdict.ACCEPTED for verdict in ledger.verdict])
    weights, residuals, verdict = np.full(len(ledger), np.nan), np.full(len(ledger), np.nan), list(ledger.verdict)
    weights[rows], residuals[rows] = weight, residual
    for row in rows[weight < 0.5].tolist():
        verdict[row] = Verdict.REJECTED_BY_SOLVER
    return replace(ledger, weight=weights, residual_after=residuals, verdict=verdict)
