"""What all figures of a study share: a colour for each method and drive, captions, and labels of pairs."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

_METHODS = {
    "bobb": "#d62728",
    "bobb_paper": "#ff9d4d",
    "hybrid": "#8c1a1a",
    "bovf": "#1f77b4",
    "fabmap": "#7b4fb5",
    "vlad": "#2ca02c",
    "gist": "#8c6d4f",
    "thumbnail": "#7f7f7f",
}
"""Warm where boxes are mined, cold where words are counted, dull where whole images are compared."""
_OTHERS = ("#e377c2", "#17becf", "#bcbd22", "#393b79", "#637939", "#843c39")
_DRIVES = ("#4c9f70", "#e0a43a", "#3d5a80", "#b56576", "#6d597a", "#84a59d", "#bc6c25", "#264653")
_CAPTION_PT = 8
_CHARACTERS_AN_INCH = 15.5
"""Characters of a caption line at that size."""


def colour_of(method: str, methods: Sequence[str]) -> str:
    """A recogniser's own colour; methods with settings get one by their place in the list."""
    if method in _METHODS:
        return _METHODS[method]
    others = [name for name in methods if name not in _METHODS]
    return _OTHERS[others.index(method) % len(_OTHERS)]


def colour_of_drive(number: int) -> str:
    return _DRIVES[number % len(_DRIVES)]


def pair_label(row: dict[str, Any]) -> str:
    """`query in map`, on two lines."""
    return f"{row['query']}\nin {row['map']}" if row["query"] != row["map"] else f"{row['query']}\nin its past"


def explain(figure: Figure, title: str, caption: str) -> None:
    """A title above, and below it all what is seen."""
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
    lines = textwrap.fill(caption, int(figure.get_figwidth() * _CHARACTERS_AN_INCH))
    figure.supxlabel(lines, x=0.01, ha="left", fontsize=_CAPTION_PT, color="#444444")
