"""The raw-image library: reference images with their raw SIFT features, which serve as the vocabulary.

A visual word is the number of a library feature. A feature of any image is translated into all the library features
that are its near neighbours and close enough: several words per feature (section III-B of Tanaka et al. 2014).
"""

from __future__ import annotations

import hashlib
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import faiss
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import Field

import vplog
from vplog.data import Features, Reference
from vplog.errors import LibraryError
from vplog.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from vplog.data import Bytes, Float32s, Int32s, Ints

_MAX_FEATURES = 50_000_000
"""Features a library file may claim: 6.4 GB of descriptors, far above any library that one machine can search."""


class WordSettings(Settings):
    """How features become words."""

    features: int = Field(default=800, ge=1)
    """Strongest features of an image that are used."""
    neighbours: int = Field(default=10, ge=1)
    """Nearest library features looked at for each feature."""
    max_l1: float = Field(default=0.4, ge=0)
    """Largest L1 distance of two descriptors of unit L1 length (0..2) that are the same word: the paper's check."""
    hnsw_links: int = Field(default=16, ge=2)
    """Links of a node in the HNSW graph (Malkov & Yashunin 2018); recall of the first neighbour .94 at ef 16."""
    hnsw_ef_construction: int = Field(default=40, ge=1)
    """Breadth of the search while the graph is built."""
    hnsw_ef_search: int = Field(default=16, ge=1)
    """Breadth of the search for a feature's neighbours; raised to `neighbours` where it is less."""


@dataclass(frozen=True, eq=False)
class Words:
    """Words of M features: feature f has values[start[f]:start[f + 1]], increasing."""

    start: Int32s
    values: Int32s


@dataclass(frozen=True, eq=False)
class Library:
    """L reference images; feature f of reference r is one of start[r]..start[r + 1]."""

    references: list[Reference]
    start: Int32s
    """(L + 1,)."""
    descriptors: Bytes
    """(F, 128)."""
    points: Float32s
    """(F, 2) px of its reference."""
    settings: WordSettings
    words: Words
    """Of the library's own features: each has its own number at least."""
    index: Any

    def __len__(self) -> int:
        return len(self.references)

    def size(self, reference: int) -> tuple[int, int]:
        """Width and height in px."""
        features = self.references[reference].features
        return features.width, features.height

    def translate(self, descriptors: Bytes) -> Words:
        """Words of (M, 128) descriptors. Exact whole-number distances: the same on any machine and thread."""
        return _translate(self.index, self.descriptors, descriptors, self.settings, own=False)


def build_library(references: Iterable[Reference], settings: WordSettings, threads: int) -> Library:
    """Index the references' strongest features. Raises LibraryError where they have none."""
    kept = [_strongest(reference, settings.features) for reference in references]
    if not kept:
        raise LibraryError("A library needs at least one reference image; none was given.")
    start = np.concatenate([[0], np.cumsum([len(reference.features) for reference in kept])]).astype(np.int32)
    if start[-1] == 0:
        raise LibraryError(f"None of the {len(kept)} reference images has a single feature; choose other images.")
    descriptors = np.concatenate([reference.features.descriptors for reference in kept])
    points = np.concatenate([reference.features.points for reference in kept])
    index = _index(descriptors, settings)
    words = _own_words(index, descriptors, settings, threads)
    return Library(kept, start, descriptors, points, settings, words, index)


def _strongest(reference: Reference, count: int) -> Reference:
    f = reference.features
    cut = Features(f.points[:count], f.sizes[:count], f.descriptors[:count], f.depth_m[:count], f.width, f.height)
    return Reference(reference.image, cut, reference.drive, reference.stamp_ns)


def _index(descriptors: Bytes, settings: WordSettings) -> Any:
    """HNSW over the descriptors, built on one thread: the order of insertion decides the graph.

    Squared distances are whole numbers below 2^24, so float32 sums them without rounding in any order.
    """
    # bytes as they are, not as floats: the same distances from a quarter of the memory, 1.5 times as fast
    index: Any = faiss.index_factory(descriptors.shape[1], f"HNSW{settings.hnsw_links}_SQ8_direct")
    index.train(descriptors[:1].astype(np.float32))
    index.hnsw.efConstruction = settings.hnsw_ef_construction
    index.hnsw.efSearch = max(settings.hnsw_ef_search, settings.neighbours)
    threads = faiss.omp_get_max_threads()
    faiss.omp_set_num_threads(1)
    try:
        index.add(descriptors.astype(np.float32))
    finally:
        faiss.omp_set_num_threads(threads)
    return index


def _own_words(index: Any, descriptors: Bytes, settings: WordSettings, threads: int) -> Words:
    def part(rows: slice) -> Words:
        faiss.omp_set_num_threads(1)
        return _translate(index, descriptors, descriptors[rows], settings, own=True, first=rows.start)

    parts = [slice(at, at + 1000) for at in range(0, len(descriptors), 1000)]
    with ThreadPoolExecutor(threads) as pool:
        done = list(pool.map(part, parts))
    counts = np.concatenate([np.diff(words.start) for words in done])
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    return Words(start, np.concatenate([words.values for words in done]))


def _translate(
    index: Any, library: Bytes, descriptors: Bytes, settings: WordSettings, own: bool, first: int = 0
) -> Words:
    """Near neighbours that pass the L1 check; with `own`, row r is library feature first + r and has its own word."""
    if len(descriptors) == 0:
        return Words(np.zeros(1, np.int32), np.zeros(0, np.int32))
    neighbours = index.search(descriptors.astype(np.float32), settings.neighbours)[1]
    close = l1_distance(descriptors, library, neighbours) < settings.max_l1
    neighbours = np.where(close & (neighbours >= 0), neighbours, np.iinfo(np.int64).max)
    if own:
        mine = first + np.arange(len(descriptors))[:, None]
        neighbours = np.where(neighbours == mine, np.iinfo(np.int64).max, neighbours)
        neighbours = np.concatenate([mine, neighbours], axis=1)
    neighbours.sort(axis=1)
    valid = neighbours < np.iinfo(np.int64).max
    start = np.concatenate([[0], np.cumsum(valid.sum(axis=1))]).astype(np.int32)
    return Words(start, neighbours[valid].astype(np.int32))


def l1_distance(descriptors: Bytes, library: Bytes, neighbours: Ints) -> Float32s:
    """(M, k) L1 distance, 0..2, of descriptors (M, 128) scaled to unit L1 length to library rows (M, k)."""
    a = descriptors.astype(np.float32)
    b = library[neighbours].astype(np.float32)
    a /= np.maximum(a.sum(axis=-1, keepdims=True), 1.0)
    b /= np.maximum(b.sum(axis=-1, keepdims=True), 1.0)
    b -= a[:, None]
    return np.abs(b, out=b).sum(axis=-1)


def content_hash(library: Library, settings: Settings) -> str:
    """sha256 over the settings and every feature: what descriptors depend on."""
    digest = hashlib.sha256(json.dumps(settings.model_dump(mode="json"), sort_keys=True).encode())
    sizes = np.array([library.size(r) for r in range(len(library))], "<i4")
    for array in (sizes, library.start.astype("<i4"), library.points.astype("<f4"), library.descriptors):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


_FEATURES = pa.schema(
    [
        ("reference", pa.int32()),
        ("x", pa.float32()),
        ("y", pa.float32()),
        ("size", pa.float32()),
        ("descriptor", pa.binary(128)),
    ]
)
_REFERENCES = pa.schema(
    [
        ("drive", pa.string()),
        ("stamp_ns", pa.int64()),
        ("width", pa.int32()),
        ("height", pa.int32()),
        ("image", pa.binary()),
    ]
)


def save_library(library: Library, settings: Settings, folder: Path) -> None:
    """Write references.parquet (images as PNG), features.parquet and library.json, the last one last."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "library.json").unlink(missing_ok=True)
        features = [reference.features for reference in library.references]
        owners = np.repeat(np.arange(len(library), dtype=np.int32), np.diff(library.start))
        pq.write_table(
            pa.table(
                {
                    "reference": owners,
                    "x": library.points[:, 0],
                    "y": library.points[:, 1],
                    "size": np.concatenate([f.sizes for f in features]),
                    "descriptor": pa.FixedSizeBinaryArray.from_buffers(
                        pa.binary(128), len(owners), [None, pa.py_buffer(np.ascontiguousarray(library.descriptors))]
                    ),
                },
                schema=_FEATURES,
            ),
            folder / "features.parquet",
            compression="zstd",
        )
        pq.write_table(
            pa.table(
                {
                    "drive": [r.drive for r in library.references],
                    "stamp_ns": [r.stamp_ns for r in library.references],
                    "width": [f.width for f in features],
                    "height": [f.height for f in features],
                    "image": [cv2.imencode(".png", r.image)[1].tobytes() for r in library.references],
                },
                schema=_REFERENCES,
            ),
            folder / "references.parquet",
            compression="none",
        )
        record = {
            "vplog": vplog.__version__,
            "hash": content_hash(library, settings),
            "references": len(library),
            "features": int(library.start[-1]),
            "settings": settings.model_dump(mode="json"),
        }
        (folder / "library.json").write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise LibraryError(f"Cannot write the library {folder}: {error.strerror or error}.") from None


def read_library_record(folder: Path) -> dict[str, Any]:
    """library.json of a saved library. Raises LibraryError where the folder is not one."""
    try:
        record = json.loads((folder / "library.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise LibraryError(
            f"{folder} is not a library: it has no library.json. Build one: vplog library LOG -o {folder}"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise LibraryError(f"{folder}/library.json cannot be read: {error}.") from None
    if not isinstance(record, dict) or not {"hash", "settings"} <= record.keys():
        raise LibraryError(f"{folder}/library.json lacks its hash or settings; build the library anew.")
    return record


def load_references(folder: Path) -> list[Reference]:
    """The references of a saved library, in their order. Raises LibraryError where the files do not fit together."""
    try:
        files = pq.ParquetFile(folder / "features.parquet"), pq.ParquetFile(folder / "references.parquet")
        for file, schema in zip(files, (_FEATURES, _REFERENCES), strict=True):
            if not file.schema_arrow.equals(schema) or file.metadata.num_rows > _MAX_FEATURES:
                raise LibraryError(f"{folder}: the tables are not those of a library; build it anew.")
        features, references = (file.read() for file in files)
        if any(column.null_count for table in (features, references) for column in table.columns):
            raise LibraryError(f"{folder}: the tables have empty cells; build the library anew.")
        entries = references.to_pylist()
    except (OSError, ValueError, pa.ArrowException) as error:  # ValueError: a drive's name that is no UTF-8
        raise LibraryError(f"{folder} cannot be read: {str(error).splitlines()[0]}. Build the library anew.") from None
    owners = features["reference"].to_numpy()
    start = np.searchsorted(owners, np.arange(len(references) + 1))
    if len(owners) and (owners[0] < 0 or owners[-1] >= len(references) or np.any(np.diff(owners) < 0)):
        raise LibraryError(f"{folder}: features.parquet names references that references.parquet lacks.")
    points = np.column_stack([features["x"].to_numpy(), features["y"].to_numpy()]).astype(np.float32)
    sizes = features["size"].to_numpy()
    descriptors = np.frombuffer(b"".join(features["descriptor"].to_pylist()), np.uint8).reshape(-1, 128)
    result = []
    for row, entry in enumerate(entries):
        part = slice(int(start[row]), int(start[row + 1]))
        width, height = entry["width"], entry["height"]
        if not (0 < width < 2**15 and 0 < height < 2**15) or not np.all(
            (points[part] > -1) & (points[part] < [width, height])
        ):
            raise LibraryError(f"{folder}: reference {row} has features outside its {width} x {height} image.")
        image = _decode(entry["image"])
        if image is None or image.shape != (height, width):
            raise LibraryError(f"{folder}: the image of reference {row} is damaged; build the library anew.")
        nothing = np.full(part.stop - part.start, np.nan, np.float32)
        found = Features(points[part], sizes[part], descriptors[part], nothing, width, height)
        result.append(Reference(image.astype(np.uint8, copy=False), found, entry["drive"], entry["stamp_ns"]))
    return result


def _decode(data: bytes) -> np.ndarray | None:
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:  # no bytes at all, or a size that OpenCV refuses
        return None
