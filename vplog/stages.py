"""Every plug-in point on one screen. A method is a frozen settings object that makes its state."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:
    import pyarrow as pa

    from vplog import data
    from vplog.execution.execution import Execution


class EncodedFrame(Protocol):
    """An image as the log holds it. Reading is sequential; decoding is the workers' job, and only for keyframes."""

    @property
    def stamp_ns(self) -> int: ...

    def decode(self, colour: bool = False) -> data.Frame:
        """The grey image with its depth, and with its `colour`. Raises LogError where the bytes are not an image."""
        ...


@runtime_checkable
class Log(Protocol):
    """One recorded drive. `vplog.logs.open(path)` finds the kind by content."""

    @property
    def name(self) -> str: ...

    @property
    def warnings(self) -> list[str]:
        """Problems found so far, one sentence each; grows while reading."""
        ...

    def info(self) -> data.LogInfo: ...

    def camera(self) -> data.Camera: ...

    def further_cameras(self) -> list[str]:
        """Image topics of further cameras of the body; by `TopicChoice.of_camera` a log has each as its own."""
        ...

    def stamps(self) -> data.Ints:
        """(F,) header stamps of the chosen camera's frames in ns, increasing, without decoding one."""
        ...

    def frames(self, stamp_ns: data.Ints) -> Iterator[EncodedFrame]:
        """The frames with these stamps, in order of time."""
        ...

    def file_names(self) -> list[str] | None:
        """Path of each frame's file below the folder of images, in the order of `stamps()`; None of a recording."""
        ...

    def odometry(self) -> data.Odometry | None: ...

    def has_depth(self) -> bool:
        """Whether its frames come with depth or with a right image."""
        ...

    def lidar(self) -> data.Lidar | None:
        """The lidar that may give the odometry; None where there is none, or it is not needed."""
        ...

    def scans(self, stamp_ns: data.Ints) -> Iterator[data.Scan]:
        """The lidar's scans with these stamps, in order of time, one at a time; those that do not decode are left out
        and counted."""
        ...

    def gps(self) -> data.Gps | None: ...

    def imu(self) -> data.Imu | None:
        """The IMU beside images that give the odometry; None where there is none, or its mount is not known."""
        ...

    def truth(self) -> data.Trajectory | data.Gps | None:
        """Ground truth that comes with it: poses of the body or the camera, or positions."""
        ...

    def without_odometry(self) -> str:
        """The remedy where `odometry()` is None, in a sentence."""
        ...


class Extractor(Protocol):
    def __call__(self, image: data.Bytes, depth_m: data.Float32s | None = None) -> data.Features: ...


class PlaceIndex(Protocol):
    """A map of places, rebuilt from descriptors alone."""

    def __len__(self) -> int: ...

    def scores(self, descriptor: Any, stop: int | None = None) -> data.Float32s:
        """(stop,) similarity to each of the rows below `stop` (all where None), comparable between queries."""
        ...

    def query(self, descriptor: Any, k: int, stop: int | None = None) -> data.Ranking:
        """The k best rows below `stop` (all rows where None). Rows that share nothing are left out."""
        ...


@runtime_checkable
class ProbableIndex(PlaceIndex, Protocol):
    """A map that also gives the probability of each of its places."""

    def posterior(self, descriptor: Any, stop: int | None = None) -> tuple[data.Floats, float]:
        """(stop,) float64 probability of each place, and that of a place that is not in the map; they sum to 1."""
        ...


class PlaceState(Protocol):
    """A recogniser that has learned its library or vocabulary. Safe to share between threads."""

    @property
    def arrow_type(self) -> pa.DataType:
        """Arrow type of one place in a table."""
        ...

    @property
    def hash(self) -> str:
        """sha256 over all that descriptors depend on; descriptors of different hashes do not compare."""
        ...

    @property
    def bits(self) -> int:
        """Size of one place descriptor, in bits."""
        ...

    def describe(self, features: data.Features) -> Any: ...

    def to_arrow(self, descriptors: Sequence[Any]) -> pa.Array: ...

    def from_arrow(self, column: pa.Array) -> Sequence[Any]:
        """Raises LibraryError where the column is of another recogniser or library."""
        ...

    def index(self, descriptors: Sequence[Any]) -> PlaceIndex: ...

    def save(self, folder: Path) -> None: ...


@runtime_checkable
class FrameState(PlaceState, Protocol):
    """A recogniser that looks at the image itself."""

    @property
    def colour(self) -> bool:
        """Whether frames are decoded in colour for it."""
        ...

    def describe_frame(self, frame: data.Frame) -> Any: ...


@runtime_checkable
class StoredState(PlaceState, Protocol):
    """A recogniser whose descriptors were computed elsewhere."""

    def stored(self, log: Log, stamp_ns: data.Ints, query: bool | None) -> Sequence[Any]:
        """The descriptors of frames of a log, which is the `query` of a pair of logs or its map, or None where it is
        one of many. Raises LibraryError where they are not those of this log."""
        ...


@runtime_checkable
class BoxState(PlaceState, Protocol):
    """A recogniser that explains an image by boxes on reference images."""

    @property
    def references(self) -> Sequence[data.Reference]:
        """The library, in the order of the reference numbers of places."""
        ...

    def windows(self, rank: int) -> data.Floats:
        """(I, 4) x0 y0 x1 y1, as shares of an image's sides: its windows that are searched on the reference of that
        rank."""
        ...

    def boxes(self, place: Any) -> data.Boxes: ...

    def voting_maps(self, features: data.Features, references: Sequence[int]) -> list[data.Floats]:
        """(rows, columns) votes of the features of an image for each of these references, 1 at most; zeros without a
        vote."""
        ...

    def shared(self, places: Sequence[Any], query: data.Int32s, match: data.Int32s) -> data.SharedReferences:
        """The references that explain both places of each of C pairs of rows of `places`."""
        ...


@runtime_checkable
class EvidenceState(PlaceState, Protocol):
    """A recogniser that weighs several kinds of evidence, and not everywhere alike."""

    def evidence(self, query: Any, match: Any) -> str:
        """The kind of evidence with most of the score of two places: `keypoints`, `keypoints and patches`, `patches` or
        `words`; empty where they have nothing in common."""
        ...


@runtime_checkable
class CodedState(PlaceState, Protocol):
    """A recogniser whose places are short codes, which a map indexes by inverted lists on disk."""

    @property
    def shape(self) -> tuple[int, int]:
        """Number of references, and codes of a place on each."""
        ...

    @property
    def references(self) -> Sequence[data.Reference]:
        """The images of its library."""
        ...

    @property
    def pairing(self) -> Any:
        """Codes of two places that are compared."""
        ...

    def overlaps(self) -> data.Bytes:
        """(256, 256) similarity of two codes."""
        ...

    def subset(self, references: data.Ints, execution: Execution) -> CodedState:
        """The recogniser with some of the references alone, in their order."""
        ...

    def on_subset(self, column: pa.Array, references: data.Ints) -> pa.Array:
        """The places of a column by some of the references alone, with the numbers that `subset` gives them."""
        ...

    def lists(self, *columns: pa.Array) -> Any:
        """The inverted lists of the places of several columns. Raises LibraryError where one is of another library."""
        ...


def index_of_part(state: PlaceState, descriptors: Sequence[Any]) -> PlaceIndex:
    """An index of some places of a map, whose scores compare with those of its other parts: where they depend on all
    places, as FAB-MAP's posterior does, the recogniser's own for that."""
    return getattr(state, "index_of_part", state.index)(descriptors)


class Recogniser(Protocol):
    def learn(self, references: Iterable[data.Reference], execution: Execution) -> PlaceState: ...

    def load(self, folder: Path, execution: Execution) -> PlaceState: ...


class Optimiser(Protocol):
    def __call__(self, graph: data.PoseGraph) -> data.Solution: ...
