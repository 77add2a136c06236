"""Batches of the real drives: the same bytes by every engine and after every kill, and what they take."""

from __future__ import annotations

import hashlib
import json
import os
import random
import resource
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.benchmarks.measure import Figure

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

PARTS = ("engines", "kill", "add", "cluster")
"""What `--only` may name."""
NAMES = ("gardens_day_left.mcap", "gardens_day_right.mcap", "gardens_night_right.mcap", "kitti00", "seven_scenes.bag")
"""In the folder VPLOG_DATA / drives."""
ADD_BAR = 1.2
"""Time of a drive added to a finished map, to that of its own run."""
_ROUNDS = 3
"""Of the drive that is added."""
CLUSTER_DRIVES = 20
_REACH = 2.5
"""Sum of the moments of all kills, to the time of the whole: what a kill costs is computed once more, which is half of
it where there are ten."""


@dataclass(frozen=True)
class Setting:
    """What every command of the benchmark has in common."""

    logs: list[Path]
    library: Path
    folder: Path
    options: list[str]


@dataclass(frozen=True)
class Ended:
    """A command that has ended."""

    told: dict[str, Any]
    seconds: float
    cpu_seconds: float
    """Of it and all its processes that it waited for."""


def batch(only: Sequence[str], kills: int, assignments: Sequence[str]) -> Iterator[Figure]:
    """Figures of the parts named, of all where none is; nothing where there are no real drives."""
    data = Path(os.environ.get("VPLOG_DATA", Path(__file__).parents[3] / "shared" / "data")) / "drives"
    logs = [data / name for name in NAMES if (data / name).exists()]
    if len(logs) < 2:
        return
    options = [option for one in assignments for option in ("--set", one)]
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "library"
        command("library", *logs, "-o", library, *options)
        setting = Setting(logs, library, Path(folder), options)
        wanted = only or PARTS
        if {"engines", "kill"} & set(wanted):
            whole = Path(folder) / "jobs-1"
            alone = make(setting, whole, logs, "--jobs", 1)
            if "engines" in wanted:
                yield from engines(setting, whole, alone)
            if "kill" in wanted:
                yield killed(setting, whole, alone, kills)
        if "add" in wanted:
            yield from added(setting)
        if "cluster" in wanted:
            yield on_a_cluster(setting)


def command(*arguments: object) -> Ended:
    """A vplog verb with --json in a process of its own. Raises where it fails."""
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    line = [sys.executable, "-m", "vplog", *map(str, arguments), "--json"]
    done = subprocess.run(line, stdout=subprocess.PIPE, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Ended(json.loads(done.stdout), round(time.perf_counter() - began, 1), round(cpu, 1))


def make(setting: Setting, root: Path, logs: Sequence[Path], *more: object) -> Ended:
    return command("batch", *logs, "-o", root, "--library", setting.library, *setting.options, *more)


def files(root: Path, ending: str = "") -> dict[str, tuple[int, str]]:
    """Inode and sha256 of every file with this ending that is not hidden, by name."""
    return {
        path.relative_to(root).as_posix(): (path.stat().st_ino, hashlib.sha256(path.read_bytes()).hexdigest())
        for path in sorted(root.rglob(f"*{ending}"))
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(root).parts)
    }


def differing(root: Path, whole: Path) -> list[str]:
    """Names of the tables that only one of two maps has, or that are not the same in both."""
    ours, theirs = ({name: text for name, (_, text) in files(at, ".parquet").items()} for at in (root, whole))
    return sorted(name for name in ours.keys() | theirs.keys() if ours.get(name) != theirs.get(name))


def peaks(told: dict[str, Any]) -> dict[str, float]:
    return {drive["drive"]: drive["peak_memory_mb"] for drive in told["drives"]}


def engines(setting: Setting, whole: Path, alone: Ended) -> Iterator[Figure]:
    """Tables that differ from those of one job."""
    tables = len(files(whole, ".parquet"))
    told = {"seconds": alone.seconds, "cpu_seconds": alone.cpu_seconds, "tables": tables, "peak_mb": peaks(alone.told)}
    yield Figure("batch: --jobs 1", alone.seconds, None, True, told)
    ways = {"--jobs 4": ("--jobs", 4), "--engine ray": ("--engine", "ray")}
    for name, way in ways.items():
        root = setting.folder / name.replace(" ", "")
        done = make(setting, root, setting.logs, *way)
        other = differing(root, whole)
        facts = {"seconds": done.seconds, "to --jobs 1": round(done.seconds / alone.seconds, 3)}
        facts |= {"peak_mb": peaks(done.told), "differing": other}
        yield Figure(f"batch: {name}, tables that differ from --jobs 1", len(other), 0, True, facts)
        shutil.rmtree(root)


def killed(setting: Setting, whole: Path, alone: Ended, kills: int) -> Figure:
    """Kill -9 at moments from a seed, each at work: a batch that ends before is held against the whole, and another one
    begun. The moments reach some way beyond the time of the whole, so that the join at its end is hit, too."""
    root, moments, chance, other = setting.folder / "killed", list[str](), random.Random(kills), set[str]()
    line = [sys.executable, "-m", "vplog", "batch", *setting.logs, "-o", root, "--library", setting.library]
    text = [str(part) for part in (*line, "--jobs", 2, *setting.options)]
    ends = 0
    while len(moments) < kills:
        moment = chance.uniform(0, _REACH * 2 * alone.seconds / kills)
        with subprocess.Popen(text, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            try:
                process.wait(moment)
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
        if process.returncode == -signal.SIGKILL:
            moments.append(f"{moment:.1f} s: {len(list(root.glob('runs/*')))} drives in, {_parts_of_join(root)} joined")
            continue
        other |= set(differing(root, whole))
        ends += 1
        shutil.rmtree(root)
    done = make(setting, root, setting.logs, "--jobs", 2)
    other |= set(differing(root, whole))
    facts = {"kills": moments, "ended": ends + 1, "last_seconds": done.seconds, "differing": sorted(other)}
    facts |= {"seconds": alone.seconds, "tables": len(files(whole, ".parquet")), "peak_mb": peaks(alone.told)}
    shutil.rmtree(root)
    return Figure(f"batch: tables that differ after {kills} kills", len(other), 0, True, facts)


def _parts_of_join(root: Path) -> int:
    """Pairs of drives that are looked through."""
    return len(list(root.glob("joins/*/match=*.parquet")))


def added(setting: Setting) -> Iterator[Figure]:
    """The last walk of the Gardens, or else the last drive, added to a map of the others; and run by itself. In turns,
    and the medians are told: machines are noisy."""
    new = next((log for log in setting.logs if log.name == NAMES[2]), setting.logs[-1])
    others = [log for log in setting.logs if log != new]
    root, run, grown = (setting.folder / name for name in ("before", "run", "grown"))
    make(setting, root, others, "--jobs", 1)
    turns: dict[str, list[Ended]] = {"run": [], "without": [], "joined": []}
    before: dict[str, tuple[int, str]] = {}
    for _ in range(_ROUNDS):
        turns["run"].append(command("run", new, "-o", run, "--library", setting.library, *setting.options))
        shutil.rmtree(run)
        for way, options in (("without", ["--no-join"]), ("joined", [])):
            shutil.rmtree(grown, ignore_errors=True)
            shutil.copytree(root, grown)
            before = files(grown)
            turns[way].append(make(setting, grown, [*others, new], "--jobs", 1, *options))
    after = files(grown)
    changed = sorted(name for name in before if name in after and before[name] != after[name])
    gone = sorted(before.keys() - after.keys())
    made = sorted(after.keys() - before.keys())
    apart_from_it = [name for name in made if f"drive={new.stem}/" not in name]
    facts: dict[str, Any] = {"changed": changed, "gone": gone, "new_in_other_folders": apart_from_it, "new": len(made)}
    yield Figure("batch: files of other drives that an added one changes", len(others_of(changed, new)), 0, True, facts)
    seconds = {way: [one.seconds for one in ended] for way, ended in turns.items()}
    cpu = {way: [one.cpu_seconds for one in ended] for way, ended in turns.items()}
    told = turns["joined"][-1].told["joined"]
    names = {"without": "a drive added", "joined": "the same with closures between the drives"}
    for way, name in names.items():
        facts = {"seconds": seconds[way], "run_seconds": seconds["run"], "cpu": cpu[way], "run_cpu": cpu["run"]}
        facts["cpu to run"] = round(statistics.median(cpu[way]) / statistics.median(cpu["run"]), 3)
        facts |= {"joined": told["pairs"], "stages": told["stages"]} if way == "joined" else {}
        ratio = statistics.median(seconds[way]) / statistics.median(seconds["run"])
        yield Figure(f"batch: {name}, to its own run", ratio, ADD_BAR, True, facts)
    for folder in (root, grown):
        shutil.rmtree(folder)


def others_of(changed: Sequence[str], new: Path) -> list[str]:
    """Of changed files those in the folders of other drives."""
    return [name for name in changed if "drive=" in name and f"drive={new.stem}/" not in name]


def on_a_cluster(setting: Setting) -> Figure:
    """The drives under many names on two nodes that are processes of this machine, one worker killed at work."""
    links, root = setting.folder / "links", setting.folder / "cluster"
    links.mkdir()
    for number in range(CLUSTER_DRIVES):
        log = setting.logs[number % len(setting.logs)]
        (links / f"drive{number:02d}{log.suffix}").symlink_to(log.resolve())
    with two_nodes(setting.folder) as (address, place):
        ended: list[int] = []
        watch = threading.Thread(target=_kill_one, args=(place, ended), daemon=True)
        watch.start()
        done = make(setting, root, sorted(links.iterdir()), "--engine", "ray", "--address", address, "--no-join")
        watch.join()
    drives = done.told["drives"]
    again = {one["drive"]: one["attempts"] for one in drives if one["attempts"] > 1}
    facts: dict[str, Any] = {"seconds": done.seconds, "killed": len(ended), "tried again": again}
    facts["largest_peak_mb"] = max(peaks(done.told).values())
    facts["peak_mb"] = {log.name: max(_peaks_of(log, setting, done.told), default=0.0) for log in setting.logs}
    facts["nodes"] = sorted({one["worker"].split(":")[0] for one in drives})
    missing = sum(one["state"] != "computed" for one in drives)
    shutil.rmtree(root)
    return Figure(f"batch: drives of {CLUSTER_DRIVES} that a cluster lacks, a worker killed", missing, 0, True, facts)


def _peaks_of(log: Path, setting: Setting, told: dict[str, Any]) -> list[float]:
    """Of the drives that are links to it; 0 of those that failed."""
    number = setting.logs.index(log)
    return [peak for at, peak in enumerate(peaks(told).values()) if at % len(setting.logs) == number]


@contextmanager
def two_nodes(folder: Path) -> Iterator[tuple[str, Path]]:
    """A Ray cluster with half of the cores for each node; its address, and the temporary folder of its workers."""
    from ray.cluster_utils import Cluster

    place = folder / "nodes"
    place.mkdir()
    with tempfile.TemporaryDirectory(prefix="vray-", dir="/tmp", ignore_cleanup_errors=True) as short:
        before = os.environ.get("RAY_TMPDIR")
        os.environ["RAY_TMPDIR"] = short  # sockets need a short path
        try:
            cluster = Cluster()
            for _ in range(2):
                cores = max((os.cpu_count() or 2) // 2, 1)
                cluster.add_node(num_cpus=cores, include_dashboard=False, env_vars={"TMPDIR": str(place)})
            yield str(cluster.address), place
            cluster.shutdown()
        finally:
            os.environ.pop("RAY_TMPDIR") if before is None else os.environ.update(RAY_TMPDIR=before)


def _kill_one(place: Path, ended: list[int]) -> None:
    """The first worker that is at work on a drive, some seconds later."""
    while not ended:
        for account in place.glob("vplog-*/run-*/run/run.json"):
            time.sleep(3)
            ended.append(int(account.parts[-3].split("-")[1]))
            os.kill(ended[0], signal.SIGKILL)
            return
        time.sleep(0.05)
