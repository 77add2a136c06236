"""The largest set of nodes that are all joined to each other."""

from __future__ import annotations

import numpy as np

from vplog.data import Bools, Ints


def largest_clique(joined: Bools, most_steps: int) -> tuple[Ints, bool]:
    """Nodes of the largest clique of a symmetric (K, K) matrix, increasing, and whether it is sure to be the largest.

    Branch and bound with a greedy colouring as the bound (Tomita and Seki 2003), nodes in order of degeneracy, sets of
    nodes as bits of one integer. After `most_steps` branches the branch begun is ended by a greedy search, and the best
    so far is taken. The same matrix gives the same set.
    """
    count = len(joined)
    if count == 0:
        return np.empty(0, np.int64), True
    # peeled by least degree: the last are the densest part, so the first branches find a large clique
    degree = joined.sum(1) - np.diag(joined)
    order = np.empty(count, np.int64)
    left = np.ones(count, bool)
    for place in range(count):
        node = int(np.argmin(np.where(left, degree, count + 1)))
        order[count - 1 - place] = node
        left[node] = False
        degree = degree - joined[node]
    matrix = joined[np.ix_(order, order)]
    np.fill_diagonal(matrix, False)
    packed = np.packbits(matrix, axis=1, bitorder="little")
    neighbours = [int.from_bytes(row.tobytes(), "little") for row in packed]

    best: list[int] = []
    steps = 0
    # a stack of (clique so far, nodes that may still join it in order of colour, their colours, all of them as bits)
    stack = [([], *_coloured((1 << count) - 1, neighbours, 0), (1 << count) - 1)]
    while stack:
        clique, nodes, colours, open_ = stack[-1]
        if not nodes or len(clique) + colours[-1] <= len(best):
            stack.pop()
            continue
        if steps == most_steps:
            best = max(best, _extended(clique, open_, neighbours), key=len)
            break
        steps += 1
        node = nodes.pop()
        colours.pop()
        grown, rest = [*clique, node], open_ & neighbours[node]
        stack[-1] = (clique, nodes, colours, open_ & ~(1 << node))
        if rest:
            stack.append((grown, *_coloured(rest, neighbours, len(best) - len(grown)), rest))
        elif len(grown) > len(best):
            best = grown
    return np.sort(order[best]), not stack


def _extended(clique: list[int], nodes: int, neighbours: list[int]) -> list[int]:
    """The clique with the first of the nodes (bits), the densest part, that may join it, until none may."""
    while nodes:
        node = (nodes & -nodes).bit_length() - 1
        clique, nodes = [*clique, node], nodes & neighbours[node]
    return clique


def _coloured(nodes: int, neighbours: list[int], enough: int) -> tuple[list[int], list[int]]:
    """Nodes in order of colour, and colours from 1: no two of a colour are joined, so a clique has one of each at most.

    Nodes of the first `enough` colours cannot lead to anything larger and are left out.
    """
    result: list[int] = []
    colours: list[int] = []
    colour = 0
    while nodes:
        colour += 1
        free = nodes
        while free:
            low = free & -free
            node = low.bit_length() - 1
            free &= ~(neighbours[node] | low)
            nodes &= ~low
            if colour > enough:
                result.append(node)
                colours.append(colour)
    return result, colours
