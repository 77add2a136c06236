"""The values that a report is made of, gathered by the caller."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vplog.data import Bools, Closures, Floats, Keyframes, Trajectory


@dataclass(frozen=True, eq=False)
class Judged:
    """A run compared with the truth."""

    name: str
    """The truth as it was given."""
    scores: dict[str, Any]
    """The record of `vplog evaluate --json`."""
    words: list[str] = field(default_factory=list)
    """Sentences on the closures and their criteria."""
    path: Floats | None = None
    """(T, 3) m, the truth in the frame of the trajectory; None where the truth is the log's own GPS."""
    true: Bools | None = None
    """(C,) candidates that are true: by their pose, or by place where they have none."""
    known: Bools | None = None
    """(C,) candidates that the truth covers finely enough to judge."""
    curves: dict[str, Floats] = field(default_factory=dict)
    """By what candidates are ranked: (P, 3) recall, precision and the value there, by falling value."""
    at_place: Bools | None = None
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
