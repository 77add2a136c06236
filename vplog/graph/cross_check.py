"""A robust solve held against others where it had to reject much."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field

from vplog.graph.consistency import is_loop, keep_odometry_if_worse, odometry_kept
from vplog.graph.robust_kernels import DcsSettings, GemanMcClureSettings
from vplog.settings import Settings

if TYPE_CHECKING:
    from vplog.data import PoseGraph, Solution


class CrossCheckSettings(Settings):
    """When the solve of verified closures is compared with other methods."""

    use: bool = True
    """Whether to compare with other methods."""
    rejected_share: float = Field(default=0.1, ge=0, le=1)
    """Share of the closures that the solve may reject without it: verification lets few false ones through, and a true
    one in a hundred is lost by design."""
    rejected: int = Field(default=3, ge=0)
    """Least number that it must reject for a comparison, as a share of few means nothing."""


def cross_checked(graph: PoseGraph, solution: Solution, settings: CrossCheckSettings) -> Solution:
    """The solution, or the odometry poses where other methods find that the closures as a body contradict it.

    Where much was rejected, DCS and Geman-McClure, which weigh all closures alike, solve the graph too. If the inliers
    of each bend the odometry more than its noise allows, the closures contradict the odometry, not each other.
    """
    loops = is_loop(graph)
    accepted, count = int((solution.weight[loops] > 0.5).sum()), int(loops.sum())
    if not settings.use or accepted == 0 or count - accepted < max(settings.rejected, settings.rejected_share * count):
        return solution
    findings = []
    for kernel in (DcsSettings(), GemanMcClureSettings()):
        other = kernel(graph)
        if keep_odometry_if_worse(graph, other) is other:
            return solution
        findings.append(f"{kernel.kind} {int((other.weight[loops] > 0.5).sum())}")
    return odometry_kept(
        graph,
        solution,
        f"robust methods disagree about the {count} verified closures: the solve keeps {accepted}, "
        f"{' and '.join(findings)}, and each contradicts the odometry's noise: the closures are false as a set, or the "
        "noise is set too small.",
    )
