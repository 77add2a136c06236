"""Every named departure of `bobb` from the paper, and the setting that takes it back."""

from __future__ import annotations

from dataclasses import dataclass

BASE = "bobb"
"""The recogniser that the departures are of."""


@dataclass(frozen=True)
class Departure:
    """One idea, on its own."""

    name: str
    """What is there without it, in a few words."""
    undone_by: tuple[str, ...]
    """Assignments of settings, as `--methods bobb:setting=value` takes them."""
    why: str
    """What the idea is for, in one sentence."""

    @property
    def method(self) -> str:
        """The recogniser without it, as `--methods` takes it."""
        return ":".join((BASE, *self.undone_by))


DEPARTURES = (
    Departure(
        "plain SIFT", ("root_sift=false",), "Roots of descriptors keep a few large values from ruling the distance."
    ),
    Departure("grain too", ("least_size=0",), "The smallest features are grain that another camera or light lacks."),
    Departure("keypoints alone", ("patch_weight=0",), "Patches need no detector, which fails in the dark."),
    Departure("patches alone", ("features=0",), "Keypoints are found again where the view turns or comes nearer."),
    Departure("800 keypoints", ("features=800",), "More describe blurred views, and cost twice the time."),
    Departure("own image left out", ("own=false",), "A later visit is explained by the image of the first one."),
    Departure("weights not rooted", ("share_power=1",), "The root lets more than the first reference decide."),
    Departure(
        "boxes of a tenth",
        ("box_columns=6", "box_rows=3"),
        "Boxes of half the sides measure how far apart they are; smaller ones miss each other at once.",
    ),
    Departure("10 neighbours", ("neighbours=10",), "The scale of distances is read off a far neighbour, not a match."),
    Departure("all matches weigh alike", ("reach=100",), "Distances change with light, so a match counts relatively."),
    Departure(
        "no agreement", ("agreement_floor=1",), "Matches of one place move alike from view to view; chance ones do not."
    ),
    Departure("popular ones count fully", ("popularity=0",), "What explains every view distinguishes none."),
    Departure("J = 4", ("references=4",), "More references explain more of a view, at twelve bytes each."),
    Departure("2 x 2 windows", ("windows_along=2",), "Nine windows say where in the view a box comes from."),
    Departure("windows of a quarter", ("window_share=0.25",), "A window must hold enough features to be found again."),
    Departure("best window only", ("pairing=best",), "Eq. (1); the same window says that the view is the same."),
    Departure("same window only", ("pairing=same",), "The best window also finds a view from nearer or aside."),
)
"""One row of the study each."""
