"""The picture of a candidate closure for viewers and the report, drawn in a few ms: both frames with their matches
above, the references that both share below, with boxes and voting maps."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vplog.data import Bools, Bytes, Floats
from vplog.results.report.charts import subsampled

_AGREES, _OTHER = (111, 224, 53), (61, 77, 255)
"""Blue, green, red: the green and red of `vplog explain`."""
_QUERY, _MATCH = (46, 157, 255), (255, 195, 76)
"""Boxes of either frame: orange and blue, as blue, green, red."""
_MOST_LINES = 80
"""Lines of either kind, subsampled: more hide so small a picture."""
_WIDE = 2.0
"""Images wider than this, against their height, are laid one above the other."""
_GAP_PX = 6
_PANELS = 4
"""Panels below, all in one row but under wide images."""
_HEAT = 0.6
"""Opacity of the most voted place of a voting map."""
_TEXT = 0.4
"""Scale of OpenCV's font: letters of 9 px."""


@dataclass(frozen=True, eq=False)
class FramePanel:
    """One of the two frames."""

    image: Bytes
    """(h, w) grey."""
    title: str
    points: Floats
    """(K, 2) places of the matches, as shares of its sides."""


@dataclass(frozen=True, eq=False)
class ReferencePanel:
    """One reference image."""

    image: Bytes
    """(h, w) grey."""
    title: str
    query_boxes: Floats
    """(I, 4) x0 y0 x1 y1 as shares of its sides, NaN where there is none."""
    match_boxes: Floats
    votes: Floats | None
    """(rows, columns) 0..1, drawn as heat."""


def collage(query: FramePanel, match: FramePanel, agrees: Bools, panels: list[ReferencePanel]) -> Bytes:
    """(H, W, 3) blue, green, red."""
    height, width = query.image.shape
    stacked = width > _WIDE * height
    offset = np.array([0, height + _GAP_PX]) if stacked else np.array([width + _GAP_PX, 0])
    whole = np.maximum([width, height], offset + match.image.shape[::-1])
    canvas = np.full((whole[1], whole[0], 3), 24, np.uint8)
    for panel, at in ((query, np.zeros(2, np.int64)), (match, offset)):
        high, wide = panel.image.shape
        canvas[at[1] : at[1] + high, at[0] : at[0] + wide] = panel.image[..., None]
    here, there = (
        np.round(panel.points * panel.image.shape[::-1] + at).astype(np.int64)
        for panel, at in ((query, np.zeros(2)), (match, offset))
    )
    for wanted, colour in ((False, _OTHER), (True, _AGREES)):
        for row in subsampled(np.flatnonzero(agrees == wanted), _MOST_LINES).tolist():
            cv2.line(canvas, here[row].tolist(), there[row].tolist(), colour, 1, cv2.LINE_AA)
    _write(canvas, query.title, (0, 0))
    _write(canvas, match.title, (int(offset[0]), int(offset[1])))
    # a quarter of a wide image would be too flat to see
    many = _PANELS // 2 if stacked else _PANELS
    rows = [_row(panels[at : at + many], canvas.shape[1], many) for at in range(0, min(len(panels), _PANELS), many)]
    return np.vstack([canvas, *rows])


def _row(panels: list[ReferencePanel], width: int, many: int) -> Bytes:
    """(h, width, 3): references side by side, in the places for so many."""
    each = (width - (many - 1) * _GAP_PX) // many
    drawn = [_panel(panel, each) for panel in panels]
    row = np.full((_GAP_PX + max(one.shape[0] for one in drawn), width, 3), 24, np.uint8)
    for number, one in enumerate(drawn):
        left = number * (each + _GAP_PX)
        row[_GAP_PX : _GAP_PX + one.shape[0], left : left + one.shape[1]] = one
    return row


def _panel(panel: ReferencePanel, width: int) -> Bytes:
    height = max(1, round(panel.image.shape[0] * width / panel.image.shape[1]))
    grey = cv2.resize(panel.image, (width, height), interpolation=cv2.INTER_AREA)
    image = np.repeat(np.asarray(grey, np.uint8)[..., None], 3, axis=2)
    if panel.votes is not None:
        votes = np.asarray(cv2.resize(panel.votes.astype(np.float32), (width, height)))[..., None].clip(0.0, 1.0)
        heat = np.asarray(cv2.applyColorMap(np.round(255 * votes).astype(np.uint8), cv2.COLORMAP_INFERNO))
        image = np.round(image * (1.0 - _HEAT * votes) + heat * (_HEAT * votes)).astype(np.uint8)
    for boxes, colour in ((panel.query_boxes, _QUERY), (panel.match_boxes, _MATCH)):
        for box in boxes[np.isfinite(boxes).all(1)]:
            corners = np.round(box * [width, height, width, height]).astype(np.int64).tolist()
            cv2.rectangle(image, corners[:2], corners[2:], colour, 1)
    _write(image, panel.title, (0, 0))
    return image


def _write(image: Bytes, text: str, at: tuple[int, int]) -> None:
    """White letters on black in the corner at that place."""
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, _TEXT, 1)
    x, y = at
    cv2.rectangle(image, (x, y), (x + width + 5, y + height + below + 3), (0, 0, 0), -1)
    cv2.putText(image, text, (x + 3, y + height + 2), cv2.FONT_HERSHEY_SIMPLEX, _TEXT, (255, 255, 255), 1, cv2.LINE_AA)
