"""What a report tells, gathered by the caller."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from vplog.data import Closures, Floats, Keyframes, Trajectory


@dataclass(frozen=True, eq=False)
class Judged:
    """A run held against the truth."""

    name: str
    """Of the truth, as it was given."""
    scores: dict[str, Any]
    """What `vplog evaluate --json` says."""
    words: list[str] = field(default_factory=list)
    """Sentences on the closures and their criteria."""
    path: Floats | None = None
    """(T, 3) m, the truth in the frame of the trajectory; None where the truth is the log's own GPS."""
    true: NDArray[np.bool_] | None = None
    """(C,) candidates whose pose is that of the truth, and those without a pose whose frames show one place."""
    known: NDArray[np.bool_] | None = None
    """(C,) candidates that the truth can tell of."""
    curves: dict[str, Floats] = field(default_factory=dict)
    """By what candidates are ranked: (P, 3) recall, precision and the value there, by falling value."""
    at_place: NDArray[np.bool_] | None = None
    """(C,) candidates whose two frames show one place."""


@dataclass(frozen=True, eq=False)
class Content:
    """A finished run."""

    record: dict[str, Any]
    """What run.json holds."""
    keyframes: Keyframes
    world_from_body: Floats
    """(N, 4, 4) of the keyframes, solved."""
    closures: Closures
    before: Trajectory
    """The odometry, laid on the first solved keyframe."""
    after: Trajectory
    pictures: dict[int, bytes]
    """JPEG of a candidate closure by its row."""
    references: dict[int, bytes]
    """JPEG of a reference by its number."""
    fixes_m: Floats | None
    """(F, 3) m, satellite fixes in the frame of the trajectory."""
    judged: Judged | None = None
