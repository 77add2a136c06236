"""The preflight as a page: one file, no network, readable on a phone, light or dark as the reader has it."""

from __future__ import annotations

import base64
from html import escape
from typing import TYPE_CHECKING, Any

import cv2

from vplog.errors import ResultError
from vplog.info import in_words
from vplog.results.atomic import replacing

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from vplog.data import Bytes
    from vplog.info import Preflight

_QUALITY = 75
"""Of the JPEG: pictures to recognise a place by, of some 20 kB each."""
_STYLE = """
:root { color-scheme: light dark; --ink: #1c1e21; --dim: #5d646d; --line: #d9dde2; --back: #fff; --card: #f4f6f8;
  --good: #1a7f37; --bad: #b42318; --warn: #8a5a00; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e8eb; --dim: #9aa3ad; --line: #33383f; --back: #14161a;
  --card: #1d2026; --good: #4ac26b; --bad: #ff7b72; --warn: #e3b341; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 70rem; padding: 1rem; background: var(--back); color: var(--ink);
  font: 16px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.4rem; margin: .2rem 0; overflow-wrap: anywhere; }
h2 { font-size: 1.05rem; margin: 1.6rem 0 .4rem; }
p { margin: .3rem 0; overflow-wrap: anywhere; }
.dim { color: var(--dim); }
.good { color: var(--good); } .bad { color: var(--bad); } .warn { color: var(--warn); }
pre { background: var(--card); padding: .7rem; overflow-x: auto; border-radius: 6px; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .9rem; }
th, td { text-align: left; vertical-align: top; padding: .3rem .7rem .3rem 0; border-bottom: 1px solid var(--line); }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; }
tr.unused td { color: var(--dim); }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1rem; margin: 0; }
dt { color: var(--dim); } dd { margin: 0; overflow-wrap: anywhere; }
.pictures { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 11rem), 1fr)); gap: .7rem; }
figure { margin: 0; } img { width: 100%; display: block; border-radius: 6px; }
figcaption { color: var(--dim); font-size: .85rem; }
"""


def write_page(path: Path, found: Preflight) -> None:
    """Raises ResultError where the file cannot be written."""
    try:
        with replacing(path) as stream:
            stream.write(page(found).encode())
    except OSError as error:
        raise ResultError(f"Cannot write {path}: {error.strerror}. Choose another with --html.") from None


def page(found: Preflight) -> str:
    """The whole document. All that comes from the log is escaped."""
    record = found.record
    name = escape(record["path"].rstrip("/").rsplit("/", 1)[-1])
    seconds = max(record["end_ns"] - record["start_ns"], 0) / 1e9
    ready = '<p class="good">Ready to run.</p>' if record["ready"] else '<p class="bad">A run would not start.</p>'
    parts = [
        f"<h1>{name}</h1>",
        f'<p class="dim">{escape(record["kind"])}, {record["messages"]} messages over {seconds:.1f} s</p>',
        ready,
        *_lines("Problems", "bad", record["problems"]),
        *([f"<h2>Command</h2><pre>{escape(record['command'])}</pre>"] if record["command"] else []),
        *_lines("Warnings", "warn", record["warnings"]),
        f"<h2>What would be used</h2><dl>{''.join(_facts(record))}</dl>",
        *_pictures(found.pictures, record["start_ns"]),
        *_gaps(record["gaps"]),
        "<h2>Topics</h2>",
        _topics(record["topics"]),
    ]
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta name="color-scheme" content="light dark"><title>{name}: vplog info</title><style>{_STYLE}</style>'
    )
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n' + "\n".join(parts) + "\n</body></html>\n"


def _lines(title: str, kind: str, lines: Iterable[str]) -> Iterator[str]:
    told = [f'<p class="{kind}">{escape(line)}</p>' for line in lines]
    if told:
        yield f"<h2>{title}</h2>"
        yield from told


def _facts(record: dict[str, Any]) -> Iterator[str]:
    for name, text in in_words(record):
        yield f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>"


def _pictures(pictures: list[tuple[int, Bytes]], start_ns: int) -> Iterator[str]:
    if not pictures:
        return
    yield '<h2>Pictures</h2><div class="pictures">'
    for stamp_ns, image in pictures:
        after = f"{(stamp_ns - start_ns) / 1e9:.1f} s"
        yield f'<figure><img alt="frame at {after}" src="{_source(image)}"><figcaption>{after}</figcaption></figure>'
    yield "</div>"


def _source(image: Bytes) -> str:
    """A picture as a data URL."""
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"


def _gaps(gaps: list[dict[str, Any]]) -> Iterator[str]:
    if gaps:
        yield "<h2>Gaps</h2>"
    for gap in gaps:
        yield f"<p>{gap['seconds']:.1f} s without {escape(gap['what'])}, {gap['after_s']:.1f} s behind the start</p>"


def _topics(topics: list[dict[str, Any]]) -> str:
    rows = []
    for topic in topics:
        rate = "" if topic["rate_hz"] is None else f"{topic['rate_hz']:.1f}"
        size = f"{topic['width']} x {topic['height']}" if topic["width"] else ""
        cells = [("", topic["name"]), ("", topic["type"]), ("n", topic["count"]), ("n", rate)]
        cells += [("", " ".join(text for text in (topic["pixels"], size) if text)), ("", topic["why"])]
        text = "".join(f'<td class="{kind}">{escape(str(value))}</td>' for kind, value in cells)
        rows.append(f'<tr class="{"used" if topic["used"] else "unused"}">{text}</tr>')
    head = "<th>topic<th>type<th class=n>count<th class=n>Hz<th>images<th>why"
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
