"""Places as vectors that were computed elsewhere: one a frame, in .npy or Parquet files.

A pair of .npy files, `queries_descriptors.npy` and `database_descriptors.npy`, is what VPR-methods-evaluation writes
(github.com/gmberton/VPR-methods-evaluation): its rows are in the order of the images' paths as text.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from vplog.data import Features, Float32s, Ints, Reference
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places.dense import VectorIndex, VectorState, nearness, products
from vplog.places.library_files import RelearnedSettings, keep_references, references_hash
from vplog.places.network_vector import MAX_DIMENSIONS
from vplog.settings import FileName
from vplog.stages import Log
from vplog.storage.parquet_limits import open_table, read_table

_QUERIES, _DATABASE = "queries_descriptors.npy", "database_descriptors.npy"
_COLUMNS = "stamp_ns (int64), vector (a list of floats), and drive (text) where it is of several drives"


class VectorsSettings(RelearnedSettings):
    """Vectors from files. It learns nothing: the references only go into the library."""

    LOCATIONS: ClassVar = frozenset({"file"})

    kind: Literal["vectors"] = "vectors"
    """Name of the recogniser."""
    file: FileName = ""
    """A .npy file of (F, D) vectors; one of a pair `queries_descriptors.npy`, `database_descriptors.npy`, or their
    folder; or a .parquet file with stamp_ns, vector and, of several drives, drive."""
    model: str = ""
    """Name of what made the vectors: drives whose vectors lie in files of their own compare where it is the same.
    Empty: those of one file alone compare."""
    metric: Literal["cosine", "l2"] = "cosine"
    """Vectors are brought to unit length and compared by their product, or as they are by their distance."""
    order: Literal["names", "frames"] = "names"
    """Rows of a .npy file: by the paths of the images as text, 10.jpg before 2.jpg, where the log is a folder of
    images; or the frames as vplog counts them."""

    def learn(self, references: Iterable[Reference], execution: Execution) -> VectorsState:
        """Nothing to learn. Raises LibraryError where there is no reference, or no file of vectors."""
        paths = vectors_files(self.file)
        tables = [_opened(path) for path in paths]
        lengths = {table.dimensions for table in tables}
        if len(lengths) > 1:
            raise LibraryError(f"{paths[0]} and {paths[1].name} have vectors of {sorted(lengths)} values: no pair.")
        value = pa.float16() if self.metric == "cosine" else pa.float32()
        return VectorsState(self, keep_references(references), tables, pa.list_(value, lengths.pop()))


@dataclass(frozen=True, eq=False)
class VectorsState(VectorState):
    """The files. Shared freely between threads."""

    settings: VectorsSettings  # pyrefly: ignore[bad-override]
    references: list[Reference]  # pyrefly: ignore[bad-override]
    tables: Sequence[_Rows | _Stamped]
    """One file, or that of queries, then that of the map."""
    arrow_type: pa.FixedSizeListType  # pyrefly: ignore[bad-override]

    @cached_property
    def hash(self) -> str:
        content = self.settings.model or self._content
        about = f"{references_hash(self.references, self.settings)} {content} {self.tables[0].dimensions}"
        return hashlib.sha256(about.encode()).hexdigest()

    @property
    def token(self) -> str:
        """Stands for all that descriptors depend on, the files of a named model among it."""
        return f"{self.hash} {self._content}"

    @cached_property
    def _content(self) -> str:
        """sha256 of the files."""
        digest = hashlib.sha256()
        for table in self.tables:
            with table.path.open("rb") as stream:
                digest.update(hashlib.file_digest(stream, "sha256").digest())
        return digest.hexdigest()

    def stored(self, log: Log, stamp_ns: Ints, query: bool | None) -> list[NDArray[Any]]:
        """(D,) of each frame. Raises LibraryError where they are not, or may not be, those of this log."""
        tables = self.tables
        if query is not False and not tables[0].names_drives and (query is None or len(tables) == 1):
            raise LibraryError(
                f"{tables[0].path} does not say which of several drives its vectors are of. Give a pair {_QUERIES}, "
                f"{_DATABASE}, or a Parquet file with {_COLUMNS}."
            )
        vectors = tables[0 if query else -1].of(log, stamp_ns, self.settings.order)
        if not np.isfinite(vectors).all():
            raise LibraryError(f"{self.settings.file} has values that are not finite for frames of {log.name}.")
        if self.settings.metric == "cosine":
            vectors = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.float32(1e-9))
        return list(vectors.astype(self.arrow_type.value_type.to_pandas_dtype()))

    def describe(self, features: Features) -> NDArray[Any]:
        """Raises LibraryError: features have no vector."""
        raise LibraryError("Vectors from a file belong to frames of a log, and only features are given. Give the log.")

    def index(self, descriptors: Sequence[NDArray[Any]]) -> VectorIndex:
        similarity = products if self.settings.metric == "cosine" else nearness
        return VectorIndex(self.matrix(descriptors, np.float32), similarity)


class _Rows:
    """The vectors of a .npy file, by the number of the frame."""

    names_drives = False

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._vectors = np.load(path, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            why = str(error).splitlines()[0][:200]
            raise LibraryError(f"{path} is not a .npy file of numbers: {why}. Write it with numpy.save.") from None
        shape, kind = self._vectors.shape, self._vectors.dtype.kind
        if len(shape) != 2 or not 1 <= shape[1] <= MAX_DIMENSIONS or kind != "f":
            raise LibraryError(
                f"{path} has an array of {' x '.join(map(str, shape))} {self._vectors.dtype}; vectors are one row a "
                f"frame, of at most {MAX_DIMENSIONS} floats."
            )
        self.dimensions: int = shape[1]

    def of(self, log: Log, stamp_ns: Ints, order: str) -> Float32s:
        stamps = log.stamps()
        if len(stamps) != len(self._vectors):
            raise LibraryError(
                f"{self.path} has {len(self._vectors)} vectors, and {log.name} has {len(stamps)} frames. Give a row "
                "for each, or a Parquet file with the stamps of those there are."
            )
        frames = np.searchsorted(stamps, stamp_ns)
        names = log.file_names()
        if order == "names" and names is not None:
            place = np.empty(len(stamps), np.int64)
            place[sorted(range(len(stamps)), key=names.__getitem__)] = np.arange(len(stamps))
            frames = place[frames]
        return np.asarray(self._vectors[frames], np.float32)


class _Stamped:
    """The vectors of a Parquet file, by stamp."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with open_table(path) as file:
                names = [name for name in ("stamp_ns", "vector", "drive") if name in file.schema_arrow.names]
                table = read_table(path, file, names)
            self._stamp_ns = table["stamp_ns"].cast(pa.int64()).to_numpy()
            vectors = table["vector"].combine_chunks()
            lengths = np.unique(vectors.value_lengths().to_numpy(zero_copy_only=False))
            self._drives = np.array(table["drive"].to_pylist()) if "drive" in names else None
            values = vectors.flatten().cast(pa.float32())
        except (OSError, KeyError, ValueError, AttributeError, pa.ArrowException) as error:
            why = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
            raise LibraryError(f"{path} is not a table of vectors: {why}. Its columns are {_COLUMNS}.") from None
        if len(lengths) != 1 or not 1 <= lengths[0] <= MAX_DIMENSIONS or vectors.null_count + values.null_count:
            raise LibraryError(f"{path} has vectors of different or no lengths. Its columns are {_COLUMNS}.")
        self.dimensions, self.names_drives = int(lengths[0]), self._drives is not None
        self._vectors = values.to_numpy(zero_copy_only=False).reshape(-1, self.dimensions)

    def of(self, log: Log, stamp_ns: Ints, order: str) -> Float32s:
        rows = np.arange(len(self._stamp_ns)) if self._drives is None else np.flatnonzero(self._drives == log.name)
        rows = rows[np.argsort(self._stamp_ns[rows], kind="stable")]
        known = self._stamp_ns[rows]
        if (np.diff(known) == 0).any():
            raise LibraryError(f"{self.path} has two vectors of one stamp for {log.name}. Its columns are {_COLUMNS}.")
        at = np.minimum(np.searchsorted(known, stamp_ns), max(len(known) - 1, 0))
        found = known[at] == stamp_ns if len(known) else np.zeros(len(stamp_ns), bool)
        if not found.all():
            missing = np.flatnonzero(~found)
            raise LibraryError(
                f"{self.path} lacks {len(missing)} of {len(stamp_ns)} frames of {log.name}, the first at stamp_ns "
                f"{int(stamp_ns[missing[0]])}. Give a vector for each."
            )
        return self._vectors[rows[at]]


def check_drives(places: object, drives: int) -> None:
    """Raises LibraryError where places are vectors of a file that does not say which of so many drives they are of."""
    if isinstance(places, VectorsSettings) and places.file and drives > 1:
        path = vectors_files(places.file)[-1]
        if not _opened(path).names_drives:
            raise LibraryError(
                f"{path} does not say which of {drives} drives its vectors are of. Give a Parquet file with "
                f"{_COLUMNS}; or, with places.model, one drive at a time with its own file."
            )


def _opened(path: Path) -> _Rows | _Stamped:
    return _Rows(path) if path.suffix == ".npy" else _Stamped(path)


def vectors_files(name: str) -> list[Path]:
    """The file, or the pair that it is one of. Raises LibraryError where there is none."""
    path = Path(name)
    if not name or not path.exists():
        what = f"{path} does not exist" if name else "No file of vectors is named"
        raise LibraryError(f"{what}. Name it: vectors:FILE.npy, vectors:FILE.parquet, or places.file in a pipeline.")
    folder = path if path.is_dir() else path.parent
    pair = [folder / _QUERIES, folder / _DATABASE]
    if path.is_dir() or path in pair:
        for missing in (one for one in pair if not one.is_file()):
            raise LibraryError(f"{missing} is missing: a pair of vectors is {_QUERIES} and {_DATABASE} in one folder.")
        return pair
    if path.suffix not in (".npy", ".parquet"):
        raise LibraryError(f"{path} is neither .npy nor .parquet. Write the vectors with numpy.save.")
    return [path]
