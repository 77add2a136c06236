"""What the sections of the page are made of: text, numbers, tables, keys. Whatever comes from outside is escaped."""

from __future__ import annotations

import base64
import html
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Verdict

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

KEPT = (Verdict.ACCEPTED, Verdict.DIRECTION_ONLY)
"""What the solve took, at least in part."""
_NAMES = {
    "before": "odometry", "after": "optimised", "truth": "truth", "gps": "GPS fixes", "yes": "accepted closures",
    "other": "closures taken without metres", "no": "closures the solver rejected",
}  # fmt: skip


def text(value: Any) -> str:
    """Anything as text that is only text."""
    return html.escape(str(value), quote=True)


def figure(value: Any, digits: int = 1) -> str:
    """A number for reading, with thin spaces in long ones; `-` where it is not known."""
    if not isinstance(value, int | float) or (isinstance(value, float) and not np.isfinite(value)):
        return "-"
    return f"{value:,.{0 if isinstance(value, int) else digits}f}".replace(",", "\u202f")


def part(record: dict[str, Any], *names: str) -> dict[str, Any]:
    """What run.json holds under these names, empty where that is no object."""
    found: Any = record
    for name in names:
        found = found.get(name) if isinstance(found, dict) else None
    return found if isinstance(found, dict) else {}


def key(kinds: Iterable[str], names: dict[str, str] | None = None) -> str:
    """What each line is."""
    said = []
    for kind in kinds:
        dot = kind == "gps"
        mark = f'<path class="{"dot " if dot else "track "}{kind}" d="{"M13 5h0" if dot else "M0 5H26"}"/>'
        said.append(f'<span><svg viewBox="0 0 26 10" aria-hidden="true">{mark}</svg>{(names or _NAMES)[kind]}</span>')
    return f'<div class="key">{"".join(said)}</div>'


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], words: Sequence[int] = ()) -> str:
    """Cells are HTML already."""
    head = "".join(f'<th scope="col"{_words(at, words)}>{name}</th>' for at, name in enumerate(heads))
    body = "".join(
        f"<tr>{''.join(f'<td{_words(at, words)}>{cell}</td>' for at, cell in enumerate(row))}</tr>" for row in rows
    )
    return f'<div class="box"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _words(at: int, words: Sequence[int]) -> str:
    return ' class="words"' if at in words else ""


def inline(data: bytes) -> str:
    """A JPEG as an address that holds it."""
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"
