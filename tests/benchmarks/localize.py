"""Pictures localised beside hloc's recipe: the same frames, the same poses of the map, one thread, one run.

The map's poses are the truth for both, so that only localisation differs. hloc triangulates from images alone; vplog
has the depth where the log has it. Where the truth of two passes does not agree with itself, a picture's own truth is
where the pictures around it are, by both methods, carried to it along the truth of its pass. Times are the
processor's.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from tests.benchmarks.measure import Figure, one_thread
from vplog import logs
from vplog.errors import TruthError
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.geometry.tum import read_tum
from vplog.maps.localization.localize import localize_frame
from vplog.maps.localization.places import opened
from vplog.pipeline import load_pipeline
from vplog.pipeline import run as run_drive

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from vplog.data import Camera, Floats

BARS = {"recall": 1.0, "speed": 10.0, "bytes": 100.0}
"""Least recall as a share of hloc's at the same precision; times faster for a picture, and fewer bytes for a place."""
_EVERY_FRAME = ("keyframes.distance_m=0", "keyframes.rotation_deg=0")
_NO_CLOSURES = ("verify.min_matches=1000000",)
"""So that the map keeps the poses that it is given."""


@dataclass(frozen=True)
class Scene:
    """A drive of which some frames are looked for among others."""

    drive: str
    held_out: int | None
    """One frame of so many is a picture; None where the times below part the drive."""
    map_s: tuple[float, float] = (0.0, 1e6)
    query_s: tuple[float, float] = (0.0, 1e6)
    within: tuple[float, float] = (1.0, 2.0)
    """m and degrees."""
    neighbours: int = 10
    """Images of the map that each is matched with before triangulation."""
    carried_s: float | None = None
    """Pictures within so many seconds tell the truth of one by their own answers; None: the truth of the drive."""


SCENES = {
    "seven_scenes": Scene("seven_scenes.bag", 5, within=(0.05, 5.0)),
    "kitti00": Scene("kitti00", None, (9.0, 24.0), (160.6, 171.0), neighbours=4, carried_s=2.0),
    "kitti_stereo": Scene("kitti_stereo", None, (0.0, 10.0), (10.0, 1e6), neighbours=5),
}
"""kitti00: the second pass (frames 1550-1648) in a map of the first, of which KITTI's truth is .9 m off; kitti_stereo:
the way back in the way out's."""


@dataclass(frozen=True, eq=False)
class Answer:
    """One picture, localised."""

    stamp_ns: int
    world_from_camera: Floats
    inliers: int
    seconds: float


@dataclass(frozen=True, eq=False)
class Error:
    """How far an answer is from the truth."""

    error_m: float
    error_deg: float
    inliers: int


def localize(names: list[str], folder: Path) -> Iterator[Figure]:
    """The figures of the named scenes, of all where none is named; working files go to `folder`."""
    data = Path(os.environ.get("VPLOG_DATA", Path(__file__).parents[3] / "shared" / "data")) / "drives"
    if find_spec("pycolmap") is None:
        raise SystemExit("pycolmap is not installed: pip install pycolmap")
    for name in names or SCENES:
        if not (data / SCENES[name].drive).exists():
            raise SystemExit(
                f"there is no {data / SCENES[name].drive}: set VPLOG_DATA to the folder with the real drives"
            )
        yield from _figures(name, SCENES[name], data, folder / name)


def _figures(name: str, scene: Scene, data: Path, folder: Path) -> Iterator[Figure]:
    truth = data / f"{name}.groundtruth.tum"
    stamps, poses = read_tum(truth, TruthError, "truth")
    map_log, map_choice, query_log = _parted(scene, data, folder)
    camera = query_log.camera()

    def true(stamp_ns: int) -> Floats:
        return se3.interpolate_at(stamps, poses, np.array([stamp_ns]))[0] @ camera.body_from_camera

    _write_images(folder / "hloc", scene, logs.open(map_log, map_choice), query_log, true)
    settings = [*_NO_CLOSURES, *(_EVERY_FRAME if scene.held_out else ())]
    choice = map_choice.model_copy(update={"odometry_file": truth})
    run = folder / "run"
    run_drive(map_log, run, load_pipeline("default", settings), topics=choice, execution=Execution(os.cpu_count() or 1))
    ours, places, scale = _ours(run, query_log)
    theirs, about = _hloc(folder / "hloc")
    size = (run / "landmarks.parquet").stat().st_size / places
    by_drive = [_errors(some, true) for some in (ours, theirs)]
    errors = by_drive if scene.carried_s is None else _carried_errors(ours, theirs, true, scene.carried_s)
    precision = _right(errors[0], scene) / max(len(ours), 1)
    recall = [_right(errors[0], scene), _recall_at(errors[1], scene, precision)]
    pictures = len(list((folder / "hloc" / "query").iterdir()))
    metres, degrees = scene.within
    facts = {"pictures": pictures, "localised": len(ours), "right": recall[0], "hloc's right": recall[1]}
    facts |= {f"median {who}": _median(some) for who, some in zip(("ours", "hloc's"), errors, strict=True)}
    if scene.carried_s is not None:
        facts |= {
            f"{who} by the drive's truth": _median(one) for who, one in zip(("ours", "hloc's"), by_drive, strict=True)
        }
    about_recall = f"{name}: share within {metres:g} m, {degrees:g} deg, to hloc's at our precision"
    yield Figure(about_recall, recall[0] / max(recall[1], 1), BARS["recall"], False, facts)
    seconds = [statistics.median(one.seconds for one in some) for some in (ours, theirs)]
    shown = {"ours ms": round(1e3 * seconds[0]), "hloc's ms": round(1e3 * seconds[1]), "scale": scale}
    yield Figure(f"{name}: hloc's time for a picture to ours", seconds[1] / seconds[0], BARS["speed"], False, shown)
    sizes = {"ours": round(size), "hloc's": round(about["bytes"])}
    yield Figure(f"{name}: hloc's bytes a place to ours", about["bytes"] / size, BARS["bytes"], False, sizes)


def _parted(scene: Scene, data: Path, folder: Path) -> tuple[Path, logs.TopicChoice, Any]:
    """The log of the map with the choice of its part, and that of the pictures, opened."""
    source = data / scene.drive
    folder.mkdir(parents=True, exist_ok=True)
    if scene.held_out is None:
        parts = [logs.TopicChoice(start_s=start, stop_s=stop) for start, stop in (scene.map_s, scene.query_s)]
        return source, parts[0], logs.open(source, parts[1])
    stamps = logs.open(source).stamps()
    held_out = set(stamps[scene.held_out // 2 :: scene.held_out].tolist())
    others = [_copied(source, folder / f"{part}.bag", held_out, part == "query") for part in ("map", "query")]
    return others[0], logs.TopicChoice(), logs.open(others[1])


def _copied(source: Path, to: Path, held_out: set[int], inside: bool) -> Path:
    """A ROS 1 bag with the images that are held out, or with the others."""
    from rosbags.rosbag1 import Reader, Writer
    from rosbags.typesys import Stores, get_typestore

    store, to_of = get_typestore(Stores.ROS1_NOETIC), {}
    to.unlink(missing_ok=True)
    with Reader(source) as reader, Writer(to) as writer:
        for one in reader.connections:
            text: Any = getattr(one.msgdef, "data", one.msgdef)
            to_of[one.id] = writer.add_connection(one.topic, one.msgtype, msgdef=text, md5sum=one.digest)
        for one, time_ns, raw in reader.messages():
            if one.msgtype.endswith("CompressedImage"):
                header: Any = store.deserialize_ros1(raw, one.msgtype)
                stamp = header.header.stamp
                if (stamp.sec * 10**9 + stamp.nanosec in held_out) != inside:
                    continue
            writer.write(to_of[one.id], time_ns, raw)
    return to


def _write_images(folder: Path, scene: Scene, map_log: Any, query_log: Any, true: Any) -> None:
    """Images, camera and poses, as hloc_recipe.py reads them."""
    poses = []
    for part, log in (("map", map_log), ("query", query_log)):
        (folder / part).mkdir(parents=True)
        for encoded in log.frames(log.stamps()):
            frame = encoded.decode()
            cv2.imwrite(str(folder / part / f"{frame.stamp_ns:019d}.png"), frame.image)
            if part == "map":
                poses.append(true(frame.stamp_ns).tolist())
    camera: Camera = map_log.camera()
    K = np.asarray(camera.matrix)
    tree = {
        "camera": {
            "width": camera.width, "height": camera.height,
            "parameters": [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5],
        },
        "world_from_camera": poses, "neighbours": scene.neighbours,
    }  # fmt: skip
    (folder / "scene.json").write_text(json.dumps(tree))


def _ours(run: Path, query_log: Any) -> tuple[list[Answer], int, str]:
    """Answers for the pictures that are localised, places of the map, and where its metres are from."""
    found = []
    with one_thread(), opened(run, Execution()) as places:
        frames = [encoded.decode() for encoded in query_log.frames(query_log.stamps())]
        localize_frame(places, frames[0], Execution())  # landmarks are made, and kernels loaded
        for frame in frames:
            began = time.process_time()
            one = localize_frame(places, frame, Execution())
            seconds = time.process_time() - began
            if one.found.world_from_camera is not None:
                found.append(Answer(frame.stamp_ns, one.found.world_from_camera, one.found.inliers, seconds))
        known = places.drives[0].load()
        return found, len(known.world_from_body), known.tables[0].scale


def _hloc(folder: Path) -> tuple[list[Answer], dict[str, Any]]:
    """hloc's, in a process of its own on one thread."""
    script = Path(__file__).with_name("hloc_recipe.py")
    single = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, str(script), str(folder)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=single,
        check=True,
    )  # fmt: skip
    about = json.loads(done.stdout)
    solved = [one for one in about["answers"] if one["world_from_camera"] is not None]
    answers = [
        Answer(int(Path(one["name"]).stem), np.array(one["world_from_camera"]), one["inliers"], one["seconds"])
        for one in solved
    ]
    return answers, about


def _errors(answers: list[Answer], true: Callable[[int], Floats]) -> list[Error]:
    return [_error(one, true(one.stamp_ns)) for one in answers]


def _carried_errors(
    ours: list[Answer], theirs: list[Answer], true: Callable[[int], Floats], within_s: float
) -> list[list[Error]]:
    """The errors of both methods against the pictures around: their answers, carried along the truth; the middle one,
    which is nearest to all others, is taken for the truth."""
    both = [*ours, *theirs]

    def carried(at_ns: int) -> Floats:
        around = [one for one in both if 0 < abs(one.stamp_ns - at_ns) <= within_s * 1e9]
        poses = np.array([one.world_from_camera @ se3.between(true(one.stamp_ns), true(at_ns)) for one in around])
        apart = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
        return np.asarray(poses[apart.sum(axis=1).argmin()])

    return [_errors(some, carried) for some in (ours, theirs)]


def _error(one: Answer, true: Floats) -> Error:
    error = se3.between(one.world_from_camera, true)
    turned = float(np.degrees(se3.angle(error[None]))[0])
    return Error(float(np.linalg.norm(error[:3, 3])), turned, one.inliers)


def _right(answers: list[Error], scene: Scene) -> int:
    return sum(one.error_m < scene.within[0] and one.error_deg < scene.within[1] for one in answers)


def _recall_at(answers: list[Error], scene: Scene, precision: float) -> int:
    """Most right answers among those with most inliers, of which at least this share is right."""
    order = sorted(answers, key=lambda one: -one.inliers)
    counts = [(_right(order[:count], scene), count) for count in range(1, len(order) + 1)]
    return max((right for right, count in counts if right >= precision * count), default=0)


def _median(answers: list[Error]) -> str:
    metres, degrees = (statistics.median(getattr(one, name) for one in answers) for name in ("error_m", "error_deg"))
    return f"{metres:.3f} m {degrees:.2f} deg"
