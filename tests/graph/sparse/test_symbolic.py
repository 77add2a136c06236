"""The sparse solver does what dense matrices do, with any number of threads."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.benchmarks.graphs import city
from tests.benchmarks.large_graphs import drives
from tests.graph.drive import ring
from tests.graph.gtsam_graph import as_values, weighted
from vplog.data import EdgeKind
from vplog.errors import GraphError
from vplog.execution.cores import limited
from vplog.geometry import se3
from vplog.graph import normal_equations as normal
from vplog.graph.consistency import is_loop, residual_sigma
from vplog.graph.factors import Factors
from vplog.graph.gnc import GncSettings
from vplog.graph.least_squares import descend
from vplog.graph.normal_equations import normal_equations
from vplog.graph.sparse.cholesky import Blocks, Cholesky, inverse_blocks
from vplog.graph.sparse.symbolic import Elimination

if TYPE_CHECKING:
    from vplog.data import PoseGraph

GRAPHS = {"planar": city(400, seed=1), "spatial": ring(80, loops=10).graph, "drives": drives(600, each=300, seed=2)}
EXACT = {2: 1e-4, 3: 1e-7}
"""GTSAM loses digits of a planar edge's derivative where its residual turns by less than a milliradian."""
each_graph = pytest.mark.parametrize("graph", GRAPHS.values(), ids=GRAPHS)


def random_matrix(nodes: int, chords: int, size: int, seed: int) -> tuple[Blocks, np.ndarray]:
    """A positive definite matrix of a chain with chords, some of them twice, in blocks and dense (n d, n d)."""
    random = np.random.default_rng(seed)
    a = np.concatenate([np.arange(nodes - 1), random.integers(0, nodes, chords)])
    b = np.concatenate([np.arange(1, nodes), random.integers(0, nodes, chords)])
    ends = np.stack([a, b])[:, a != b].astype(np.int32)
    a, b = np.repeat(ends, random.integers(1, 3, ends.shape[1]), axis=1)
    by_a, by_b = random.normal(size=(2, len(a), size, size))
    diagonal = np.tile(0.1 * np.eye(size), (nodes, 1, 1))
    np.add.at(diagonal, a, np.swapaxes(by_a, 1, 2) @ by_a)
    np.add.at(diagonal, b, np.swapaxes(by_b, 1, 2) @ by_b)
    other = np.swapaxes(by_a, 1, 2) @ by_b
    return Blocks(diagonal, a, b, other), whole_of(Blocks(diagonal, a, b, other))


def whole_of(matrix: Blocks) -> np.ndarray:
    nodes, size, _ = matrix.diagonal.shape
    whole = np.zeros((nodes, nodes, size, size))
    whole[range(nodes), range(nodes)] = matrix.diagonal
    np.add.at(whole, (matrix.a, matrix.b), matrix.other)
    np.add.at(whole, (matrix.b, matrix.a), np.swapaxes(matrix.other, 1, 2))
    return whole.transpose(0, 2, 1, 3).reshape(nodes * size, -1)


@pytest.mark.parametrize(
    ("nodes", "chords", "size"), [(1, 0, 3), (2, 0, 6), (40, 5, 1), (40, 30, 3), (300, 200, 3), (120, 150, 6)]
)
@pytest.mark.parametrize("seed", [0, 1])
def test_solutions_and_inverses_are_those_of_the_dense_matrix(nodes: int, chords: int, size: int, seed: int) -> None:
    matrix, whole = random_matrix(nodes, chords, size, seed)
    random = np.random.default_rng(seed)
    shape = Elimination.of(nodes, matrix.a, matrix.b)
    assert sorted(shape.place.tolist()) == list(range(nodes))
    factor = Cholesky.of(shape, matrix)
    assert factor.log_determinant() == pytest.approx(np.linalg.slogdet(whole)[1])
    right = random.normal(size=(nodes, size, 2))
    np.testing.assert_allclose(whole @ factor.solve(right).reshape(-1, 2), right.reshape(-1, 2), atol=1e-9)
    inverse = np.linalg.inv(whole).reshape(nodes, size, nodes, size).transpose(0, 2, 1, 3)
    largest = 1e-10 * np.abs(inverse).max()
    some = random.permutation(len(matrix.a))[: len(matrix.a) // 2]
    a, b = matrix.a[some], matrix.b[some]
    for found, expected in zip(
        inverse_blocks(factor, a, b), (inverse[a, a], inverse[a, b], inverse[b, b]), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=largest)
    assert Cholesky.of(shape, matrix).values.tobytes() == factor.values.tobytes()


def test_any_number_of_threads_gives_the_same_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(normal, "_EDGES_AT_ONCE", 16)
    # closures all over it, so that its fronts are large
    random, graph, more = np.random.default_rng(0), GRAPHS["drives"], 400
    a, b = random.integers(0, 599, more), random.integers(1, 300, more)
    like = random.integers(0, len(graph.a), more)
    graph = replace(
        graph,
        a=np.concatenate([graph.a, a]).astype(np.int32),
        b=np.concatenate([graph.b, (a + b) % 600]).astype(np.int32),
        a_from_b=np.concatenate([graph.a_from_b, graph.a_from_b[like]]),
        information=np.concatenate([graph.information, graph.information[like]]),
        kind=graph.kind + [EdgeKind.LOOP] * more,
    )
    poses, weight = se3.between(graph.world_from_body[:1], graph.world_from_body), np.ones(len(graph.a))

    def found() -> bytes:
        matrix, gradient, error = normal_equations(graph, weight, poses)
        matrix.diagonal[0] += 1e6 * np.eye(6)
        factor = Cholesky.of(Elimination.of(len(poses), graph.a, graph.b), matrix)
        arrays = (matrix.diagonal, matrix.other, gradient, factor.values, factor.solve(gradient[:, :, None]))
        return (
            b"".join(one.tobytes() for one in (*arrays, *inverse_blocks(factor, graph.a, graph.b)))
            + str(error).encode()
        )

    with limited(1):
        alone = found()
    for threads in (2, 5):
        with limited(threads):
            assert found() == alone


def test_matrices_of_several_parts_are_solved() -> None:
    matrix, _ = random_matrix(120, 40, 3, 0)
    inside = (matrix.a // 30 == matrix.b // 30) & (matrix.a >= 30)  # 30 nodes alone, and three parts
    parts = Blocks(matrix.diagonal, matrix.a[inside], matrix.b[inside], matrix.other[inside])
    factor = Cholesky.of(Elimination.of(120, parts.a, parts.b), parts)
    right = np.random.default_rng(0).normal(size=(120, 3, 1))
    np.testing.assert_allclose(whole_of(parts) @ factor.solve(right).reshape(-1, 1), right.reshape(-1, 1), atol=1e-9)
    inverse = np.linalg.inv(whole_of(parts)).reshape(120, 3, 120, 3).transpose(0, 2, 1, 3)
    some = slice(0, None, 7)
    _, found, _ = inverse_blocks(factor, parts.a[some], parts.b[some])
    np.testing.assert_allclose(found, inverse[parts.a[some], parts.b[some]], atol=1e-10 * np.abs(inverse).max())


@pytest.mark.parametrize("wrong", [-1.0, 0.0, np.nan])
def test_a_matrix_that_is_not_positive_definite_is_refused(wrong: float) -> None:
    matrix, _ = random_matrix(30, 5, 3, 0)
    diagonal = matrix.diagonal.copy()
    diagonal[17] *= wrong
    with pytest.raises(GraphError, match="does not constrain"):
        Cholesky.of(Elimination.of(30, matrix.a, matrix.b), matrix._replace(diagonal=diagonal))


@each_graph
def test_normal_equations_are_those_of_gtsam(graph: PoseGraph) -> None:
    random = np.random.default_rng(0)
    size, axes = (3, [2, 3, 4]) if graph.dimension == 2 else (6, list(range(6)))
    twist = np.zeros((len(graph.world_from_body), 6))
    twist[:, axes] = 0.2 * random.normal(size=(len(twist), size))
    poses = se3.between(graph.world_from_body[:1], graph.world_from_body @ se3.exp(twist))
    weight = random.uniform(0.1, 1.0, len(graph.a))
    weight[3] = 0.0
    matrix, gradient, error = normal_equations(graph, weight, poses)
    assert error == pytest.approx(0.5 * (weight * residual_sigma(graph, poses) ** 2).sum(), rel=1e-12)
    # weights of 0 leave no factor, and the gauge is on the first pose alone
    linearised = weighted(graph, np.maximum(weight, 1e-30)).linearize(as_values(poses, graph.dimension))
    expected, right = linearised.hessian()
    order = [2, 0, 1] if graph.dimension == 2 else axes
    expected = expected.reshape(-1, size, len(poses), size)[:, order][:, :, :, order].reshape(len(poses) * size, -1)
    whole, right = whole_of(matrix), right.reshape(-1, size)[:, order]
    np.testing.assert_allclose(
        whole[size:, size:], expected[size:, size:], rtol=0, atol=EXACT[graph.dimension] * np.abs(whole).max()
    )
    np.testing.assert_allclose(gradient[1:], -right[1:], rtol=0, atol=EXACT[graph.dimension] * np.abs(gradient).max())


def test_drives_that_only_closures_join_are_solved_together() -> None:
    graph = GRAPHS["drives"]
    solution = GncSettings()(graph)
    assert solution.weight[is_loop(graph)].mean() > 0.9
    apart = np.setdiff1d(np.arange(len(graph.a)), np.flatnonzero(is_loop(graph) & (graph.a < 300) & (graph.b >= 300)))
    weight = np.where(np.isin(np.arange(len(graph.a)), apart), 1.0, 0.0)
    alone = descend(Factors.of(graph), weight, graph.world_from_body, 20, 1e-6)
    np.testing.assert_allclose(alone.world_from_body[300], graph.world_from_body[300], atol=1e-6)
