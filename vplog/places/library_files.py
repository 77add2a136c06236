"""A reference library on disk, for every recogniser: images, features and settings. Loading it learns again."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa

from vplog.data import THUMBNAIL_SIDE, Features, Reference
from vplog.errors import LibraryError, nearest_path
from vplog.execution.execution import Execution
from vplog.settings import Settings
from vplog.storage.folders import check_regular
from vplog.storage.image_file import BadImageError, decode_image, image_size
from vplog.storage.json_records import has_checksum, parse_json, with_checksum
from vplog.storage.parquet_limits import check_columns, check_file, check_version, open_table, read_table, write_table
from vplog.storage.scratch import put_in_place, sync_all
from vplog.version import __version__

_FORMAT = 2
"""Version of library.json. A reader refuses a newer one. Those with images are of version 1, with thumbnails of 2."""
_MAX_FEATURES = 50_000_000
"""Features a library file may claim: 6.4 GB of descriptors, far above any library that one machine can search."""


_MOST_PX, _PX_PER_BYTE = 2**30, 100
"""Px of all images of a library that any may have, and px a byte that a larger one may: one image may stand in many
rows, and take a byte for a thousand px."""
_MAX_DESCRIPTOR = 4096
"""Bytes: above those of any local features in use."""


def check_descriptors(references: Sequence[Reference], features: Features) -> None:
    """Raises LibraryError where the library's descriptors have another length than a drive's."""
    made, own = {one.features.descriptors.shape[1] for one in references}, features.descriptors.shape[1]
    if made - {own}:
        raise LibraryError(
            f"The library's descriptors have {max(made)} bytes and this drive's {own}: they are of other local "
            "features. Build the library with these settings of features: vplog library."
        )


class RelearnedSettings(Settings):
    """Settings of a recogniser that is saved as its references."""

    def prepare(self, references: Iterable[Reference], execution: Execution) -> Any:
        """The state of a saved library."""
        return self.learn(references, execution)  # pyrefly: ignore[missing-attribute]

    def load(self, folder: Path, execution: Execution) -> Any:
        """The state of a library saved by `save_references`, whose own settings count, but for where files are now.
        Raises LibraryError where it is damaged or gives another hash."""
        record = read_library_record(folder)
        own = type(self).read(record["settings"], f"{folder}/library.json")
        here = {name: place for name in self.LOCATIONS if (place := getattr(self, name))}
        state = own.model_copy(update=here).prepare(load_references(folder, execution), execution)
        if state.hash != record["hash"]:
            raise LibraryError(
                f"{folder}: the content does not have the hash in library.json; build it again with `vplog library`."
            )
        return state


class ReferencesState:
    """A state that follows from settings and references: its hash, and how it is saved."""

    def __init__(self, settings: Any, references: list[Reference]) -> None:
        self.settings, self.references = settings, references

    @cached_property
    def hash(self) -> str:
        return references_hash(self.references, self.settings)

    def save(self, folder: Path) -> None:
        save_references(self.references, self.settings, folder, self.hash)

    def save_small(self, folder: Path) -> None:
        """Save it with thumbnails in place of the images, which figures alone need: four fifths of its bytes."""
        thumbnails = [(one, one.features.thumbnail) for one in self.references]
        small = [one if thumbnail is None else replace(one, image=thumbnail) for one, thumbnail in thumbnails]
        save_references(small, self.settings, folder, self.hash)


def keep_references(references: Iterable[Reference], features: int | None = None) -> list[Reference]:
    """The references with their `features` strongest features, None for all. Raises LibraryError for none."""
    found = [replace(one, features=one.features.rows(slice(features))) for one in references]
    if not found:
        raise LibraryError("A library needs at least one reference image, and none was given. Give a log with images.")
    return found


def references_hash(references: Sequence[Reference], settings: Settings) -> str:
    """sha256 over the settings and every feature, or the thumbnails where there is none: what descriptors depend on."""
    digest = hashlib.sha256(json.dumps(settings.identity(), sort_keys=True).encode())
    features = [reference.features for reference in references]
    start = np.concatenate([[0], np.cumsum([len(f) for f in features])]).astype("<i4")
    digest.update(np.array([(f.width, f.height) for f in features], "<i4").tobytes())
    digest.update(start.tobytes())
    for f in features:
        digest.update(np.ascontiguousarray(f.points, "<f4").tobytes())
        digest.update(np.ascontiguousarray(f.descriptors).tobytes())
        if not start[-1] and f.thumbnail is not None:  # patches are then all that there is
            digest.update(f.thumbnail.tobytes())
    return digest.hexdigest()


_FEATURES = pa.schema([("reference", pa.int32()), ("x", pa.float32()), ("y", pa.float32()), ("size", pa.float32())])
"""Columns of features.parquet but `descriptor`, whose bytes are those of the features' own."""
_REFERENCES = pa.schema(
    {"drive": pa.string(), "stamp_ns": pa.int64(), "width": pa.int32(), "height": pa.int32(), "image": pa.binary()}
)


def save_references(
    references: Sequence[Reference], settings: Settings, folder: Path, digest: str | None = None
) -> None:
    """Write references.parquet (images as PNG, or their thumbnails), features.parquet and library.json, the last one
    last; `digest` is the state's hash, where more than references and settings is in it."""
    check_regular(folder, "library.json")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "library.json").unlink(missing_ok=True)
        features = [reference.features for reference in references]
        owners = np.repeat(np.arange(len(references), dtype=np.int32), [len(f) for f in features])
        points = np.concatenate([f.points for f in features])
        sizes = np.concatenate([f.sizes for f in features])
        descriptors = np.ascontiguousarray(np.concatenate([f.descriptors for f in features]))
        column = pa.field("descriptor", pa.binary(descriptors.shape[1]))
        packed = pa.FixedSizeBinaryArray.from_buffers(column.type, len(owners), [None, pa.py_buffer(descriptors)])
        schema = _FEATURES.append(column)
        _write(folder / "features.parquet", schema, [owners, *points.T, sizes, packed], compression="zstd")
        images = [cv2.imencode(".png", r.image)[1].tobytes() for r in references]
        entries = [(r.drive, r.stamp_ns, f.width, f.height) for r, f in zip(references, features, strict=True)]
        columns = [*zip(*entries, strict=True), images]
        _write(folder / "references.parquet", _REFERENCES, columns, compression="none")
        record = {
            "format": _FORMAT if any(r.image.shape != (r.features.height, r.features.width) for r in references) else 1,
            "vplog": __version__,
            "hash": digest or references_hash(references, settings),
            "references": len(references),
            "features": len(owners),
            "settings": settings.model_dump(mode="json"),
        }
        _write_record(folder, record)
    except OSError as error:
        raise LibraryError(
            f"Cannot write the library {folder}: {error.strerror or error}. Choose another folder."
        ) from None


def _write_record(folder: Path, record: dict[str, Any]) -> None:
    part = folder / f".library.json.{os.getpid()}.part"
    part.write_text(json.dumps(with_checksum(record), indent=2) + "\n", encoding="utf-8")
    sync_all(folder)
    put_in_place(part, folder / "library.json")


def name_extractor(folder: Path, extractor: dict[str, Any] | None) -> None:
    """Add to library.json the settings of what found its features: other features may have descriptors as long. None
    where they are not known, as of libraries of earlier versions."""
    if extractor is not None:
        _write_record(folder, {**read_library_record(folder), "extractor": extractor})


def _write(path: Path, schema: pa.Schema, columns: Sequence[Any], compression: str) -> None:
    table = pa.table(dict(zip(schema.names, columns, strict=True)), schema=schema)
    with path.open("wb") as stream:
        write_table(stream, table, compression=compression)


def read_library_record(folder: Path) -> dict[str, Any]:
    """library.json of a saved library. Raises LibraryError where the folder is not one, ResultError where something in
    it is not its own file."""
    check_regular(folder, "library.json")
    try:
        check_file(folder / "library.json")
        record = parse_json((folder / "library.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise LibraryError(
            f"{folder} is not a library: it has no library.json.{nearest_path(folder)} "
            f"Build one: vplog library LOG -o {folder}"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise LibraryError(
            f"{folder}/library.json cannot be read: {error}. Build it again with `vplog library`."
        ) from None
    if not isinstance(record, dict) or not {"hash", "settings"} <= record.keys():
        raise LibraryError(f"{folder}/library.json lacks its hash or settings; build it again with `vplog library`.")
    if not has_checksum(record):
        raise LibraryError(
            f"{folder}/library.json is damaged: its checksum does not match. Copy it back, or build it again."
        )
    check_version(folder / "library.json", record.get("format", _FORMAT), _FORMAT, record.get("vplog"))
    return record


def read_sources(folder: Path) -> set[tuple[str, int]]:
    """Log and stamp in ns of every reference of a saved library. Raises LibraryError."""
    with _reading(folder):
        table = _table(folder / "references.parquet", _REFERENCES)
        return set(zip(table["drive"].to_pylist(), table["stamp_ns"].to_pylist(), strict=True))


def load_references(folder: Path, execution: Execution = Execution()) -> list[Reference]:
    """The references of a saved library, in their order. Raises LibraryError where the files do not fit together,
    ResultError where something in the folder is not its own file."""
    check_regular(folder, "library.json")
    with _reading(folder):
        features = _table(folder / "features.parquet", _FEATURES, "descriptor")
        references = _table(folder / "references.parquet", _REFERENCES)
        if any(column.null_count for table in (features, references) for column in table.columns):
            raise LibraryError(f"{folder}: the tables have empty cells; build it again with `vplog library`.")
        entries = references.to_pylist()
        claimed = sum(math.prod(image_size(one["image"]) or [0]) for one in entries)  # of thumbnails their own
        if claimed > max(_MOST_PX, _PX_PER_BYTE * (folder / "references.parquet").stat().st_size):
            raise LibraryError(f"{folder}: the images of its references claim more px than their bytes hold.")
    owners = features["reference"].to_numpy()
    start = np.searchsorted(owners, np.arange(len(references) + 1)).tolist()
    if len(owners) and (owners[0] < 0 or owners[-1] >= len(references) or np.any(np.diff(owners) < 0)):
        raise LibraryError(
            f"{folder}: features.parquet names references that references.parquet lacks; build it again."
        )
    points = np.column_stack([features["x"].to_numpy(), features["y"].to_numpy()]).astype(np.float32)
    sizes = features["size"].to_numpy()
    values = features.schema.field("descriptor").type.byte_width
    descriptors = np.frombuffer(b"".join(features["descriptor"].to_pylist()), np.uint8).reshape(-1, values)

    def reference(row: int) -> Reference:
        entry, part = entries[row], slice(start[row], start[row + 1])
        width, height = entry["width"], entry["height"]
        inside = (points[part] > -1) & (points[part] < [width, height])
        if not (0 < width < 2**15 and 0 < height < 2**15 and np.all(inside)):
            raise LibraryError(f"{folder}: reference {row} has features outside its {width} x {height} image.")
        side, stated = (THUMBNAIL_SIDE, THUMBNAIL_SIDE), image_size(entry["image"])
        try:
            image = decode_image(entry["image"]) if stated in ((width, height), side) else None
        except BadImageError:
            image = None
        if image is None or image.shape not in ((height, width), side):
            raise LibraryError(
                f"{folder}: the image of reference {row} is damaged; build it again with `vplog library`."
            )
        nothing = np.full(part.stop - part.start, np.nan, np.float32)
        thumbnail = image if image.shape == side else cv2.resize(image, side, interpolation=cv2.INTER_AREA)
        thumbnail = thumbnail.astype(np.uint8, copy=False)
        if image.shape != (height, width):  # in the image's proportions, no larger: its size is what a file claims
            across, down = (max(THUMBNAIL_SIDE * one // max(width, height), 1) for one in (width, height))
            image = cv2.resize(image, (across, down), interpolation=cv2.INTER_AREA)
        found = Features(points[part], sizes[part], descriptors[part], nothing, width, height, thumbnail)
        return Reference(image.astype(np.uint8, copy=False), found, entry["drive"], entry["stamp_ns"])

    return list(execution.map(reference, range(len(entries))))


@contextmanager
def _reading(folder: Path) -> Iterator[None]:
    """Raises LibraryError where its tables cannot be read."""
    try:
        yield
    except (OSError, ValueError, pa.ArrowException) as error:  # ValueError: a drive's name that is no UTF-8
        why = str(error).splitlines()[0].rstrip(".")
        raise LibraryError(f"{folder} cannot be read: {why}. Build it again with `vplog library`.") from None


def _table(path: Path, schema: pa.Schema, descriptor: str = "") -> pa.Table:
    """The columns of the schema and, where it is named, one of descriptors."""
    with open_table(path) as file:
        try:
            check_columns(file.schema_arrow, (column.with_nullable(False) for column in schema))
            if descriptor:
                kind = file.schema_arrow.field(descriptor).type
                if not pa.types.is_fixed_size_binary(kind) or not 1 <= kind.byte_width <= _MAX_DESCRIPTOR:
                    raise ValueError(f"descriptors of type {kind}")
                schema = schema.append(pa.field(descriptor, kind))
            if file.metadata.num_rows > _MAX_FEATURES:
                raise ValueError(f"{file.metadata.num_rows} rows")
        except (ValueError, KeyError) as error:
            raise LibraryError(
                f"{path.parent}: the tables are not those of a library ({error}); build it again with `vplog library`."
            ) from None
        return read_table(path, file, schema.names).select(schema.names)
