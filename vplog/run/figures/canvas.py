"""Figures drawn without a display, and files of them that are the same every time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from vplog.storage.scratch import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 150
"""Dots per inch of the PNG: 10 x 4.5 inches then fill three quarters of a full HD screen."""


@contextmanager
def saved_figure(
    folder: Path, name: str, width: float, height: float, kinds: tuple[Literal["png", "svg"], ...] = ("png", "svg")
) -> Iterator[Figure]:
    """A figure of so many inches to be filled, written as NAME.png and NAME.svg when the block ends well."""
    import matplotlib as mpl  # a second to load, which only figures need
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # ids by hash of the content instead of by chance; text as text, so that it can be searched
    with mpl.rc_context({"svg.hashsalt": "vplog", "svg.fonttype": "none", "font.size": 9}):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
        _settle(figure)
        for kind in kinds:
            metadata = {"Software": None} if kind == "png" else {"Date": None}
            with replacing(folder / f"{name}.{kind}") as stream:
                figure.savefig(stream, format=kind, dpi=DPI, metadata=metadata)


def _settle(figure: Figure) -> None:
    """Fix the layout, rounded: the solver's last digits differ from one process to the next."""
    figure.draw_without_rendering()
    figure.set_layout_engine(None)  # a placeholder, as "none" leaves, has each file drawn twice
    for part in figure.subfigs:
        x0, y0, x1, y1 = (round(float(value), 4) for value in part.bbox_relative.extents)
        part.bbox_relative.p0, part.bbox_relative.p1 = (x0, y0), (x1, y1)
    for axes in figure.axes:
        left, bottom, width, height = axes.get_position(original=True).bounds
        axes.set_position((round(left, 4), round(bottom, 4), round(width, 4), round(height, 4)), which="original")
    for part in (figure, *figure.subfigs):
        for text in part.texts:
            x, y = text.get_position()
            text.set_position((round(float(x), 4), round(float(y), 4)))


def as_text(name: str) -> str:
    """A name as a label: a dollar sign would begin a formula."""
    return name.replace("$", r"\$")
