"""How each recogniser stores a place, in words for outsiders: what `descriptor` is in descriptors.parquet, and which
columns it becomes in a map."""

from __future__ import annotations

_CODE = (
    "By reference, then window: where the window is found, the number of a box of places.box_columns x places.box_rows "
    "cells in a grid of places.columns x places.rows, row by row by its upper left cell; 255: nowhere."
)
_CORNERS = "By reference, then box: x0 y0 x1 y1 in cells of a grid of places.grid x places.grid; all 0: none."
_BEST_FIRST = "Numbers of the library images that explain it, best first"

LAYOUTS: dict[str, list[tuple[str, str, str]]] = {
    "bobb": [
        ("references", "uint16[J]", f"{_BEST_FIRST}; 65535: none."),
        ("weights", "uint8[J]", "How much each explains, in 255ths of the most."),
        ("boxes", "uint8[J*I]", _CODE),
    ],
    "bobb_paper": [
        ("references", "int32[J]", f"{_BEST_FIRST}; -1: none."),
        ("boxes", "uint8[J*I*4]", _CORNERS),
    ],
    "hybrid": [
        ("boxes", "as bobb", "The boxes; in a map boxes.references, boxes.weights, boxes.boxes."),
        ("signs", "uint8[W*B/8]", "One bit for each visual word and direction."),
    ],
    "bovf": [("descriptor", "(uint16 word, uint8 count)[]", "Words by number, and how often each is there.")],
    "fabmap": [("descriptor", "uint16[]", "Words that are there, increasing.")],
    "vlad": [("descriptor", "float16[D]", "Of unit length; compared by the scalar product.")],
    "gist": [("descriptor", "float16[D]", "Mean energy by scale, orientation, then block, row by row.")],
    "thumbnail": [("descriptor", "uint8[2048]", "Patch-normalised pixels, row by row.")],
}
"""Name, type and meaning of the parts. J references with I boxes or windows on each, W words of B bits: settings under
`places`, which the header of every table holds."""


def layouts() -> dict[str, list[dict[str, str]]]:
    """`LAYOUTS` as plain objects."""
    keys = ("name", "type", "description")
    return {name: [dict(zip(keys, part, strict=True)) for part in parts] for name, parts in LAYOUTS.items()}
