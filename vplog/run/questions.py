"""The questions of a finished run to a person, with the rows of the ledger they are about."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from vplog.data import Closures, EdgeKind, Floats, Ints, PoseGraph, Verdict
from vplog.errors import ResultError
from vplog.graph.build import busier, checked
from vplog.graph.questions import questions
from vplog.graph.search import bounded
from vplog.loops.false_rate import log_odds_false
from vplog.results.report.page import ClosureQuestion


def ask_ledger(
    graph: PoseGraph, weight: Floats, closures: Closures, answers: Mapping[int, bool] | None = None
) -> list[ClosureQuestion]:
    """All questions about a ledger and the graph of its run, with the weight (E,) of its edges, most telling first.

    Questions are about closures with a pose, in the solution or not, without a decision in the ledger or in `answers`,
    which are by row and not in the ledger yet. GPS fixes are ignored. Raises ResultError where ledger and graph are not
    of one run, GraphError where the poses are not determined.
    """
    graph, rows, weight = _with_candidates(graph, weight, closures)
    decided = closures.of(Verdict.ACCEPTED_BY_DECISION, Verdict.REJECTED_BY_DECISION)
    for row, accepted in (answers or {}).items():
        decided[row] = True
        weight[len(weight) - len(rows) :][rows == row] = float(accepted)
    if not len(rows) or decided[rows].all():
        return []
    odometry = np.zeros(len(weight) - len(rows))
    log_odds = np.concatenate([odometry, log_odds_false(closures)[rows]])
    found = questions(graph, weight, log_odds, np.concatenate([odometry > 0, decided[rows]]))
    row_sets = [rows[one.edges - len(odometry)] for one in found]
    order = [about[np.argsort(-closures.inliers[about], kind="stable")].tolist() for about in row_sets]
    return [ClosureQuestion(about, one.p_wrong, one.moved_m) for about, one in zip(order, found, strict=True)]


def _with_candidates(graph: PoseGraph, weight: Floats, closures: Closures) -> tuple[PoseGraph, Ints, Floats]:
    """The graph with every candidate that has a pose behind its odometry, the ledger row (L,) of each, and weights of
    0 or 1."""
    solved = np.flatnonzero(np.isfinite(closures.weight))
    odometry, loops = np.flatnonzero(graph.odometry), np.flatnonzero(~graph.odometry)
    known = np.stack([closures.match[solved], closures.query[solved]])
    if known.shape[1] != len(loops) or (known != np.stack([graph.a[loops], graph.b[loops]])).any():
        raise ResultError("closures.parquet and edges.parquet are not of one run: run it again.")
    posed = np.isfinite(closures.match_from_query).all((1, 2)) & np.isfinite(closures.information).all((1, 2))
    others = np.flatnonzero(posed & ~np.isfinite(closures.weight))
    match, query = closures.match[others], closures.query[others]
    edges = np.concatenate([odometry, loops])
    whole = replace(
        graph,
        a=np.concatenate([graph.a[edges], match]),
        b=np.concatenate([graph.b[edges], query]),
        a_from_b=np.concatenate([graph.a_from_b[edges], closures.match_from_query[others]]),
        information=np.concatenate(
            [graph.information[edges], closures.information[others] / busier(match, query)[:, None, None]]
        ),
        kind=[graph.kind[edge] for edge in edges.tolist()] + [EdgeKind.LOOP] * len(others),
    )
    used = np.concatenate([np.ones(len(odometry)), np.where(weight[loops] > 0.5, 1.0, 0.0), np.zeros(len(others))])
    return bounded(checked(whole)[0]), np.concatenate([solved, others]).astype(np.int64), used
