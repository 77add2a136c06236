"""A Ray cluster as the engine of a batch: drives as Ray tasks, on machines that share nothing but the logs.

The library goes once into Ray's object store, and from there once to each machine's. A drive's run folder is made on
the worker's own disk; it is sent from there to a map on an object store, and comes back in pieces for one in a folder.
"""

from __future__ import annotations

import hashlib
import platform
import secrets
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, InvalidStateError
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from vplog.batch.ray_cluster import ClusterHead, connected, watched_head
from vplog.batch.worker import Outcome, Task, compute_drive, made_by
from vplog.data import Bytes
from vplog.errors import SettingsError, VplogError, is_of_disk
from vplog.run.feature_extraction import ExtractionPart, compute_part, missing_parts, parts_of, put_part
from vplog.storage.remote_path import located, stands_for
from vplog.storage.scratch import files_in, pieces, scratch, write_pieces

Files = tuple[tuple[str, tuple[Any, ...]], ...]

_OTHER = "{} has another vplog, or other packages, than the machine of the batch. Install the same there."
_PROBE_S = 60.0
"""Limit of a probe of the machines' disks; with a slower machine none is taken to be shared."""
_DRIVE_BYTES = 2**30
"""Memory that Ray reserves for a drive, or what the largest machine has if that is less."""


@contextmanager
def ray_engine(address: str | None, threads: int, folder: Path | None) -> Iterator[RayEngine]:
    """The cluster at `address`, or one of this machine with so many cores that ends with the block.

    If its machines see `folder`, of the map, they do more with it. Raises SettingsError where there is no such cluster,
    or none of its machines has CPUs.
    """
    with connected(address, threads) as ray, watched_head(ray) as head:
        engine = RayEngine(ray, head, address is None)
        engine.check_cpus()
        if folder is not None:
            engine.probe_shared_disk(folder)
        yield engine


class RayEngine:
    """The cluster that this process is connected to; it computes drives elsewhere and brings their run folders here."""

    def __init__(self, ray: Any, head: ClusterHead, is_ours: bool) -> None:
        self._ray, self._head, self._is_ours, self._shares_disk = ray, head, is_ours, False
        self.executor = RayExecutor(ray, head)  # a core each
        # a process of its own for each drive, so that memory is given back
        self._drive = ray.remote(max_calls=1, max_retries=0)(call)
        self._part = ray.remote(num_cpus=1)(compute_remote_part)
        self._library: tuple[Path, Any] | None = None

    @property
    def cores(self) -> int:
        """Cores of all machines together."""
        return max(int(sum(self._of_nodes("CPU"))), 1)

    @property
    def max_cores(self) -> int:
        """Cores of the largest machine: one drive runs on one."""
        return max(int(max(self._of_nodes("CPU"))), 1)

    def concurrency(self, threads: int) -> int:
        """Drives with so many threads each that keep it busy."""
        return max(sum(int(cores) // threads for cores in self._of_nodes("CPU")), 1)

    def start(self, task: Task) -> Future[Outcome]:
        """Begin a drive; one in parts with its frames, on all machines."""
        task = task if self._shares_disk else replace(task, cache=None)
        if self._library is None or self._library[0] != task.library:
            library = {name: list(pieces(task.library / name)) for name in files_in(task.library)}
            self._library = task.library, self._ray.put(library)
        memory = min(_DRIVE_BYTES, int(max(self._of_nodes("memory"))))
        drive = self._drive.options(num_cpus=task.threads, memory=memory, name=f"vplog {task.drive}")
        if self._is_ours:  # no other tasks run there: the system shares the cores, and the last drive has all
            task = replace(task, threads=self.max_cores)
        parts = self._parts(task) if task.in_parts and self.cores > self.max_cores else []
        return self.executor.follow(drive.remote(compute_remote_drive, task, self._library[1], parts))

    def _parts(self, task: Task) -> list[tuple[ExtractionPart, Any]]:
        """The parts of a drive that are to be extracted, and the task of each, which gives its bytes."""
        try:
            found = parts_of(located(task.log), task.pipeline, task.topics, task.cache)
        except (VplogError, OSError):
            return []  # the drive's own task raises it
        missing, wanted = found if task.cache is None else missing_parts(task.cache, found), made_by()
        return [(part, self._part.remote(part, wanted)) for part in missing]

    def fetch(self, task: Task, outcome: Outcome) -> None:
        """Write the run folder from its pieces. Raises BrokenExecutor where they are lost, and ResultError."""
        remote = cast("RemoteOutcome", outcome)
        places = [(task.folder, remote.files)] + ([(task.cache, remote.cache)] if task.cache is not None else [])
        for folder, files in places:
            for name, parts in files:
                write_pieces(folder, name, (self.executor.follow(part).result() for part in parts))

    def executor_for(self, threads: int) -> Executor | None:
        """Tasks over all machines, if each of them sees the map."""
        if not self._shares_disk or self._head.is_lost:
            return None
        return RayExecutor(self._ray, self._head, min(threads, self.max_cores))

    def probe_shared_disk(self, folder: Path) -> None:
        """Whether all machines see a folder of this one."""
        sign, content = folder / "visible", secrets.token_hex(16)
        sign.write_text(content, encoding="utf-8")
        affinity = self._ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy
        nodes = [affinity(node["NodeID"], soft=False) for node in self._ray.nodes() if node["Alive"]]
        task = self._ray.remote(num_cpus=0, max_retries=0)(sees_file)
        answers = [task.options(scheduling_strategy=node).remote(str(sign), content) for node in nodes]
        with suppress(self._ray.exceptions.RayError):  # one has just left, or is slow
            self._shares_disk = all(self._ray.get(answers, timeout=_PROBE_S))
        sign.unlink()

    def check_cpus(self) -> None:
        """Raises SettingsError where no machine computes."""
        if max(self._of_nodes("CPU")) < 1:
            raise SettingsError(
                "No machine of the Ray cluster has CPUs, as with `ray start --num-cpus 0`. Add one that has some."
            )

    def _of_nodes(self, resource: str) -> list[float]:
        self._head.check()
        return [node["Resources"].get(resource, 0.0) for node in self._ray.nodes() if node["Alive"]] or [0.0]


class RayExecutor(Executor):
    """Ray tasks as `concurrent.futures` has them, with so many cores each."""

    def __init__(self, ray: Any, head: ClusterHead, cores: int = 1) -> None:
        self._ray, self._head, self._cores, self._task = ray, head, cores, ray.remote(num_cpus=cores)(call)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """A task, which goes to any node with free cores; one whose argument has a `locality`, a text, goes to the node
        that others with the same text went to, in whose cache its files are."""
        locality, task = getattr(args[0], "locality", "") if args else "", self._task
        if locality and (node := self._node_for(locality)):
            affinity = self._ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy
            task = task.options(scheduling_strategy=affinity(node, soft=True))
        return self.follow(task.remote(fn, *args, **kwargs))

    def _node_for(self, locality: str) -> str:
        """ID of the node with enough cores whose name, together with the text, has the largest hash (rendezvous
        hashing): few texts move where a node comes or goes, and none where the cluster starts again. Empty where there
        is no such node."""

        def rank(node: dict[str, Any]) -> list[bytes]:
            return [hashlib.sha256(f"{node[name]} {locality}".encode()).digest() for name in ("NodeName", "NodeID")]

        able = [one for one in self._ray.nodes() if one["Alive"] and one["Resources"].get("CPU", 0) >= self._cores]
        return max(able, key=rank)["NodeID"] if able else ""

    def follow(self, answer: Any) -> Future[Any]:
        """The future of a Ray task, whose errors are those of this side."""
        future = self._head.future()

        def settle(done: Future[Any]) -> None:
            error = done.exception()
            with suppress(InvalidStateError):  # the head was lost before
                if error is None:
                    future.set_result(done.result())
                else:
                    future.set_exception(translated(error))

        answer.future().add_done_callback(settle)
        return future


def translated(error: BaseException) -> BaseException:
    """An error of Ray as one of `concurrent.futures` where the same may end well another time; else its cause."""
    from ray import exceptions

    if isinstance(error, exceptions.RayTaskError):
        return error.cause
    for kind, text in (
        (exceptions.OutOfMemoryError, "Its machine ran out of memory. Give it more, or use fewer --jobs"),
        (exceptions.NodeDiedError, "Its machine left the cluster. Look at `ray status`"),
        (exceptions.LocalRayletDiedError, "Ray was stopped on this machine. Start it again"),
        (exceptions.ObjectLostError, "What it gave back was lost along with a machine. Look at `ray status`"),
        (exceptions.ObjectStoreFullError, "The cluster has no room for its result"),
        (exceptions.OutOfDiskError, "The cluster's disks have no room for its result"),
        (exceptions.RayError, f"Its worker was killed, perhaps because memory ran out ({type(error).__name__})"),
    ):
        if isinstance(error, kind):
            return BrokenExecutor(f"{text}, and run again.")
    return error


@dataclass(frozen=True)
class RemoteOutcome(Outcome):
    """Outcome of an attempt on another machine."""

    files: Files = ()
    """Name of every file of the run folder, drive.json last, and its pieces in Ray's object store; none of one sent."""
    cache: Files = ()
    """Files of the stage cache, where it is wanted and the batch does not share the disk."""


def call(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Any function of a module as a Ray task."""
    return function(*args, **kwargs)


def sees_file(file: str, content: str) -> bool:
    """Whether this machine sees a file that the batch has written."""
    try:
        return Path(file).read_text(encoding="utf-8") == content
    except (OSError, ValueError):
        return False


def node_name() -> str:
    """The machine, and the start of its number in the cluster: several nodes may be on one machine."""
    import ray

    return f"{platform.node()}/{ray.get_runtime_context().get_node_id()[:6]}"


def compute_remote_part(part: ExtractionPart, wanted: dict[str, Any]) -> bytes:
    """A stretch of a drive's frames. `wanted` is what the batch computes with. Raises VplogError."""
    if made_by() != wanted:
        raise VplogError(_OTHER.format(node_name()))
    return compute_part(part)


def compute_remote_drive(
    task: Task, library: dict[str, list[Bytes]], parts: list[tuple[ExtractionPart, Any]]
) -> RemoteOutcome:
    """A drive with everything on this machine's own disk; its run folder goes into the object store.

    Parts that other tasks compute are waited for, one after the other, while Ray lends out this task's cores.
    """
    import ray
    from ray import exceptions

    where = node_name()
    if any(task.record[name] != value for name, value in made_by().items()):
        return RemoteOutcome(_OTHER.format(where), "input", worker=where)
    try:
        with scratch("run") as folder:
            place, made = folder / "library", folder / "run"
            for name, content in library.items():
                write_pieces(place, name, content)
            cache = task.cache or folder / "cache"
            for part, data in parts:
                with suppress(exceptions.RayError, VplogError):  # failed, lost or damaged: it is computed here
                    put_part(cache, part, ray.get(data))
            with stands_for(place, task.library):  # run.json names the batch's, not this machine's copy
                outcome = compute_drive(replace(task, folder=made, library=place, cache=cache))
            ended: dict[str, Any] = {**vars(outcome), "worker": f"{where}:{outcome.worker.rpartition(':')[2]}"}
            if outcome.error:
                return RemoteOutcome(**ended)
            stages = _put_files(cache) if task.keep_cache and task.cache is None else ()
            return RemoteOutcome(**ended, files=() if outcome.sent else _put_files(made), cache=stages)
    except VplogError as error:
        return RemoteOutcome(str(error), "io" if is_of_disk(error) else "input", worker=where)
    except OSError as error:
        why = f"Cannot write {error.filename or 'a file'} on {where}: {error.strerror}."
        return RemoteOutcome(why, "io", worker=where)


def _put_files(folder: Path) -> Files:
    import ray

    names = sorted(files_in(folder), key=lambda name: (name == "drive.json", name))
    return tuple((name, tuple(ray.put(piece) for piece in pieces(folder / name))) for name in names)
