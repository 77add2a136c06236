"""Tables of the truth: pairs of images or labels in CSV, and pairs in NumPy files as VPR-Bench has them."""

from __future__ import annotations

import csv
import io
import pickle
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from vplog.data import Ints
from vplog.errors import TruthError, VplogError, nearest_path
from vplog.evaluate.image_names import row_finder
from vplog.stages import Log

_LINE_LIMIT = 4096
"""Characters: two paths; a file without line ends is not read whole."""
_FILE_BYTES = 2**28
"""Longest table that is read: ten million pairs of names."""
_MOST_PAIRS = 10**8
"""Pairs of a NumPy file, which may name one list many times over."""
_CSV = (
    "A table has the header `query,match` and a pair of frame numbers, from 0, or of file names a line, or the header "
    "`image,label` and the place of an image a line."
)
_NPY = "It should hold pairs, as VPR-Bench's [query, [match, ...]] a row, or a matrix of queries by frames of the map."


def read_table(path: Path) -> tuple[list[str], list[tuple[str, str, str]]]:
    """The header of a CSV, and of each line its two fields and where it is. Blank lines are skipped.

    Raises TruthError with the number of the first line that does not fit.
    """
    lines = read_lines(path, (["query", "match"], ["image", "label"]))
    _, header = next(lines, ("", []))
    rows = [(first, second, where) for where, (first, second) in lines]
    for first, second, where in rows:
        if not first or (not second and header == ["image", "label"]):
            raise TruthError(f"{where} has an empty {'label' if first else 'first field'}. {_CSV}")
    if not rows:
        raise TruthError(f"{path} holds no pair. {_CSV}")
    return header, rows


def read_lines(
    path: Path, headers: Sequence[list[str]], form: str = _CSV, error: type[VplogError] = TruthError
) -> Iterator[tuple[str, list[str]]]:
    """The place in the file and the cells of each line of a CSV that is not blank: its header, one of these unless
    there are none, and others as long. `form` ends each message.

    Raises `error` with the first line that does not fit, or where the file cannot be read.
    """
    number, width = 0, 0
    try:
        if path.stat().st_size > _FILE_BYTES:
            raise error(f"{path} is larger than {_FILE_BYTES // 2**20} MB, so it is no such table. {form}")
        with path.open(encoding="utf-8-sig", newline="") as lines:
            while line := lines.readline(_LINE_LIMIT):
                number += 1
                if len(line) >= _LINE_LIMIT:
                    raise error(f"{path}:{number} is longer than {_LINE_LIMIT} characters. {form}")
                if not line.strip():
                    continue
                if line.count('"') % 2:
                    raise error(f"{path}:{number} has a quoted field of several lines, which is not read. {form}")
                cells = [cell.strip() for cell in next(csv.reader([line]))]
                if not width and headers and cells not in headers:
                    raise error(f"{path}:{number} is not the header. {form}")
                if width and len(cells) != width:
                    raise error(f"{path}:{number} does not hold {width} fields. {form}")
                width = len(cells)
                yield f"{path}:{number}", cells
    except OSError as fault:
        raise error(f"Cannot read {path}: {fault.strerror}. {form}{nearest_path(path)}") from None
    except (UnicodeDecodeError, csv.Error):
        raise error(f"{path} is not text, and so not a CSV file. {form}") from None


def listed_rows(rows: Sequence[tuple[str, str, str]], query: Log, other: Log) -> Ints:
    """(P, 2) rows of the pairs of a table `query,match`; a line with no match names a query that has none.

    A column of whole numbers is of frame numbers, any other of file names. Raises TruthError for the first field that
    is no frame of its drive.
    """
    paired = [row for row in rows if row[1]]
    columns = [
        _rows_of([(row[at], row[2]) for row in paired], log, name)
        for at, log, name in ((0, query, "query"), (1, other, "map"))
    ]
    _rows_of([(row[0], row[2]) for row in rows], query, "query")  # those without a match are checked, too
    return np.array(columns, np.int64).reshape(2, -1).T


def _rows_of(fields: Sequence[tuple[str, str]], log: Log, name: str) -> list[int]:
    count, find = len(log.stamps()), row_finder(log.file_names(), log.name)
    if all(field.isascii() and field.isdigit() and len(field) < 10 for field, _ in fields):
        for field, where in fields:
            if int(field) >= count:
                named = "" if log.file_names() is None else " To name images, write their whole file names."
                text = f"{where}: {field} is not a frame of the {name}, whose {count} frames count from 0.{named}"
                raise TruthError(text)
        return [int(field) for field, _ in fields]
    found = [find(field) for field, _ in fields]
    if None in found:
        field, where = fields[found.index(None)]
        raise TruthError(f"{where}: {field!r} is neither a frame number nor an image of the {name} {log.name}. {_CSV}")
    return [row for row in found if row is not None]


def labels_by_row(rows: Iterable[tuple[str, str, str]], log: Log) -> list[str | None]:
    """The label of each frame by a table `image,label`; None of a frame that it does not name.

    Lines about images of another set are passed over: one table may serve all.
    """
    find, labels = row_finder(log.file_names(), log.name), list[str | None]([None] * len(log.stamps()))
    for image, label, where in rows:
        row = find(image)
        if row is not None and labels[row] not in (None, label):
            raise TruthError(
                f"{where}: {image} is at {label!r} here, and at {labels[row]!r} before. Give it one label."
            )
        if row is not None:
            labels[row] = label
    return labels


def read_array(path: Path, queries: int, matches: int) -> Ints:
    """(P, 2) pairs of a NumPy file, frame numbers below `queries` and `matches`: (P, 2) whole numbers, VPR-Bench's rows
    of a query and the list of its matches, a list of matches for each query, or a matrix of queries by matches.

    Nothing that a pickle names is imported or called. Raises TruthError.
    """
    try:
        if path.stat().st_size > _FILE_BYTES:
            raise ValueError(f"it is larger than {_FILE_BYTES // 2**20} MB")
        with path.open("rb") as stream:
            values = _array(stream)
    except OSError as error:
        raise TruthError(f"Cannot read {path}: {error.strerror}. {_NPY}") from None
    except Exception as error:  # whatever bytes do to a reader
        reason = " ".join(str(error).split())[:100]
        raise TruthError(f"{path} is not an array of whole numbers that can be read: {reason}. {_NPY}") from None
    if isinstance(values, np.ndarray) and values.shape == (queries, matches) and values.shape[1] != 2:
        return np.argwhere(values != 0).astype(np.int64)
    pairs = _pairs(values, path)
    for at, count, name in ((0, queries, "query"), (1, matches, "map")):
        if len(pairs) and not 0 <= pairs[:, at].min() <= pairs[:, at].max() < count:
            wrong = pairs[:, at][(pairs[:, at] < 0) | (pairs[:, at] >= count)][0]
            raise TruthError(f"{path}: {wrong} is not a frame of the {name}, whose {count} frames count from 0.")
    return pairs


def _array(stream: BinaryIO) -> Any:
    """An array of numbers, or the lists that an array of objects holds."""
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = read(stream)
    if kind.hasobject:
        values = _unpickled(stream.read())
        return list(zip(values[::2], values[1::2], strict=True) if shape[1:] == (2,) else enumerate(values))
    stream.seek(0)
    values = np.load(stream, allow_pickle=False)
    if values.dtype.kind not in "iub" or values.ndim != 2:
        raise ValueError(f"it holds {values.dtype} of shape {values.shape}")
    return values


def _pairs(values: Any, path: Path) -> Ints:
    if isinstance(values, np.ndarray):
        if values.shape[1] != 2:
            raise TruthError(f"{path} has shape {values.shape}, which is not one of pairs. {_NPY}")
        return values.astype(np.int64)
    pairs = []
    for query, found in values:
        matches = found if isinstance(found, list | tuple) else [found]
        if type(query) is not int or not all(type(match) is int for match in matches):
            raise TruthError(f"{path} does not hold whole numbers alone. {_NPY}")
        if len(pairs) + len(matches) > _MOST_PAIRS:
            raise TruthError(f"{path} holds more than {_MOST_PAIRS} pairs. Give fewer.")
        pairs += [(query, match) for match in matches]
    return np.array(pairs, np.int64).reshape(-1, 2)


def _unpickled(data: bytes) -> Any:
    """The lists and numbers of a pickled array. Nothing that it names is imported or called: what it may name is taken
    for a class of this call. Raises ValueError and others for anything else."""

    class Kind:
        """A type of whole numbers or objects."""

        def __init__(self, name: str, *_: Any) -> None:
            self.name = name.lstrip("<>=|")
            if self.name[:1] not in ("i", "u", "O", "b"):
                raise ValueError(f"it holds {self.name[:40]!r}")

        def __setstate__(self, state: Any) -> None:
            self.name = (">" if state[1] == ">" else "<") + self.name

    class Values(list[Any]):
        """An array as the list of its values."""

        def __init__(self, *_: Any) -> None:
            super().__init__()

        def __setstate__(self, state: Any) -> None:
            """`state` is version, shape, type, order and content."""
            numbers = isinstance(state[4], bytes)
            self.extend(np.frombuffer(state[4], state[2].name).tolist() if numbers else state[4])

    def scalar(kind: Kind, data: bytes) -> int:
        return int(np.frombuffer(data, kind.name)[0])

    named = {"_reconstruct": Values, "ndarray": Values, "dtype": Kind, "scalar": scalar, "encode": str.encode}

    class Unpickler(pickle._Unpickler):  # that of C allocates what a damaged file claims
        def find_class(self, module: str, name: str) -> Any:
            if name not in named:
                raise ValueError(f"it asks for {name[:40]!r}")
            return named[name]

    return Unpickler(io.BytesIO(data)).load()
