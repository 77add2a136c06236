"""The verbs: each a plain function of its arguments. The only place that prints and exits."""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import vplog
from vplog.errors import VplogError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from types import TracebackType

    from rich.console import Console

    from vplog.data import LogInfo
    from vplog.logs import TopicChoice
    from vplog.pipeline import Pipeline

    Verb = Callable[[argparse.Namespace], None]

_MOST = 10**9
"""Largest count an option may have: far above any drive, and whole in every number type."""
_DEMO_NEXT = "Look at it: Foxglove or rerun open result.mcap, evo reads trajectory.tum, DuckDB the .parquet files."


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Parse, run one verb, exit: 0 done, 1 a known error in one line, 2 wrong usage, 130 interrupted."""
    # before numpy loads: every stage has its own workers, and a BLAS pool inside each would only get in their way
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    arguments = _parser().parse_args(argv)
    logging.getLogger("vplog").addHandler(logging.NullHandler())  # warnings are printed with the result
    try:
        arguments.verb(arguments)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output has gone; nothing is wrong
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except KeyboardInterrupt:
        _say("interrupted; what was finished is kept, run.json says that the run is not")
        sys.exit(130)
    except VplogError as error:
        _fail(arguments, str(error))
    except MemoryError:
        _fail(arguments, "Out of memory. Use fewer --threads, or a shorter log.")
    except OSError as error:  # a full disk, a drive that went away
        _fail(arguments, f"Cannot read or write {error.filename or 'a file'}: {error.strerror or error}.")
    except Exception as error:  # a fault of ours: still one line, and how to see more
        text = " ".join(str(error).split())[:200]
        _fail(arguments, f"Internal error: {type(error).__name__}: {text}. See it with --debug.")
    sys.exit(0)


def _fail(arguments: argparse.Namespace, message: str) -> NoReturn:
    if arguments.debug:
        raise  # noqa: PLE0704 (called from an except block)
    _say(f"error: {message}")
    sys.exit(1)


def _say(message: str) -> None:
    print(f"vplog: {message}", file=sys.stderr)


def info(arguments: argparse.Namespace) -> None:
    """What is in a log, what would be used, what is wrong, the command to run."""
    from dataclasses import asdict

    from vplog import logs

    log = logs.open(arguments.log, _topics(arguments))
    found = log.info()
    camera = log.camera() if any(topic.role == "image" for topic in found.topics) or found.kind == "images" else None
    command = f"vplog run {arguments.log} -o OUT"
    if arguments.json:
        about = None
        if camera is not None:
            about = {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "matrix": None if camera.matrix is None else camera.matrix.tolist(),
                "distortion_model": camera.distortion_model,
                "distortion": camera.distortion.tolist(),
                "body_from_camera": camera.body_from_camera.tolist(),
            }
        _print_json({**asdict(found), "camera": about, "command": command})
        return
    _print_info(found)
    if camera is not None:
        text = (
            "uncalibrated" if camera.matrix is None else f"fx {camera.matrix[0, 0]:.1f} px, {camera.distortion_model}"
        )
        print(f"camera    {camera.name}: {camera.width} x {camera.height}, {text}")
    for warning in dict.fromkeys(found.warnings + log.warnings):
        print(f"warning   {warning}")
    print(f"run       {command}")


def _print_info(found: LogInfo) -> None:
    from rich.table import Table

    seconds = max(found.end_ns - found.start_ns, 0) / 1e9
    print(f"log       {found.path}\nkind      {found.kind}, {found.messages} messages over {seconds:.1f} s")
    table = Table("topic", "type", "count", "role", "used", box=None)
    for topic in found.topics:
        table.add_row(topic.name, topic.type, str(topic.count), topic.role, "yes" if topic.used else "")
    _console(sys.stdout).print(table)


def library(arguments: argparse.Namespace) -> None:
    """Build a reference library of random frames."""
    from vplog.pipeline import build_library

    pipeline = _pipeline(arguments)
    with _Progress(arguments) as progress:
        state = build_library(
            arguments.logs, arguments.output, pipeline, _topics(arguments), arguments.threads, progress
        )
    record = json.loads((arguments.output / "library.json").read_text(encoding="utf-8"))
    if arguments.json:
        _print_json({"library": str(arguments.output), **record, "descriptor_bits": state.bits})
        return
    print(
        f"{arguments.output}: {record['references']} references, {record['features']} features, "
        f"{state.bits} bits a place, hash {state.hash[:12]}"
    )


def run(arguments: argparse.Namespace) -> None:
    """A recorded drive to an optimised trajectory."""
    from vplog.errors import LogError
    from vplog.pipeline import run as run_pipeline

    if len(arguments.logs) > 1:
        raise LogError(
            f"{len(arguments.logs)} logs were given, and a run takes one drive. Run each by itself, "
            "or share places between them with one --library."
        )
    with _Progress(arguments) as progress:
        done = run_pipeline(
            arguments.logs[0],
            arguments.output,
            _pipeline(arguments),
            arguments.library,
            _topics(arguments),
            arguments.threads,
            progress,
        )
    if arguments.json:
        _print_json({"run": str(arguments.output), **done.record})
    else:
        _print_run(arguments.output, done.record)


def _print_run(out: Path, record: dict[str, Any]) -> None:
    from vplog.data import Verdict

    counts = record["counts"]
    print(f"{out}: {counts['keyframes']} keyframes of {counts['frames']} frames, {counts['candidates']} candidates")
    for name, count in counts["verdicts"].items():
        print(f"  {count:6d} {name}: {Verdict(name).sentence}")
    print(f"  {record['solution']['reason']}")
    for warning in record["warnings"]:
        _say(f"warning: {warning}")
    totals = record["totals"]
    print(f"  {totals['seconds']:.1f} s, {totals['peak_memory_mb']:.0f} MB")


def evaluate(arguments: argparse.Namespace) -> None:
    """A run against ground truth."""
    from vplog.evaluation import evaluate as evaluate_run

    found = evaluate_run(arguments.run, arguments.truth, _topics(arguments))
    if arguments.json:
        _print_json(found)
    else:
        _print_evaluation(found)


def _print_evaluation(found: dict[str, Any]) -> None:
    closures = found.get("closures")
    if closures:
        share = {
            name: "none" if closures[name] is None else f"{closures[name]:.3f}" for name in ("precision", "recall")
        }
        print(
            f"closures  {closures['accepted']} accepted, {closures['accepted_true']} of them true "
            f"(precision {share['precision']}); {closures['revisits_found']} of {closures['revisits']} revisits found "
            f"(recall {share['recall']}); {closures['opposite']} in the opposite direction"
        )
    for when in ("before", "after"):
        rpe = found.get(f"rpe_{when}")
        drift = (
            ""
            if rpe is None
            else f"   RPE {rpe['translation_rmse_m']:.4f} m, {rpe['rotation_rmse_deg']:.4f} deg a frame"
        )
        ate = found[f"ate_{when}"]
        print(f"{when:9} ATE rmse {ate['rmse_m']:.6f} m, max {ate['max_m']:.3f} m{drift}")


def compare(arguments: argparse.Namespace) -> None:
    """Place recognisers side by side on two drives, or on one that comes back."""
    from vplog.compare import compare as compare_methods
    from vplog.compare import split_methods
    from vplog.evaluate.place_truth import TruthChoice

    truth = TruthChoice(arguments.truth, arguments.tolerance, arguments.distance_m, arguments.heading_deg)
    with _Progress(arguments) as progress:
        done = compare_methods(
            arguments.query,
            arguments.map,
            split_methods(arguments.methods),
            truth,
            _pipeline(arguments),
            library=arguments.library,
            library_size=arguments.library_size,
            library_seed=arguments.library_seed,
            min_gap=arguments.min_gap,
            sequence=arguments.sequence,
            out=arguments.output,
            topics=_topics(arguments),
            threads=arguments.threads,
            progress=progress,
        )
    if arguments.json:
        _print_json(done.record)
    else:
        _print_comparison(done.record)


def _print_comparison(found: dict[str, Any]) -> None:
    from rich.markup import escape
    from rich.table import Table

    print(
        f"{found['queries']} queries, {found['positives']} with a true match, against {found['map_frames']} frames; "
        f"library of {found['library']['size']} images"
    )
    table = Table(box=None, pad_edge=False)
    table.add_column("method", overflow="fold")  # what gives way where the terminal is narrow
    for title in ("R@1", "R@5", "R@10", "ANR\n%", "AP", "R@\nP100", "F1", "bytes", "encode\nms", "query\nms"):
        table.add_column(title, justify="right", no_wrap=True)
    shares = ("r_at_1", "r_at_5", "r_at_10", "anr", "ap", "recall_at_p100", "f1")
    for name, method in found["methods"].items():
        costs = [f"{method['bytes_per_image']:g}"]
        costs += [f"{method[cost]:.2f}" for cost in ("encode_ms", "query_ms")]
        table.add_row(escape(name), *(f"{method[share]:.3f}" for share in shares), *costs)
        if "sequence" in method:
            by_sequence = method["sequence"]
            table.add_row(f"  L={by_sequence['length']}", *(f"{by_sequence[share]:.3f}" for share in shares))
    _console(sys.stdout).print(table)
    for warning in found["warnings"]:
        _say(f"warning: {warning}")


def config(arguments: argparse.Namespace) -> None:
    """Every setting of a pipeline, as YAML that a pipeline file may hold."""
    import yaml

    tree = _pipeline(arguments).model_dump(mode="json")
    if arguments.json:
        _print_json(tree)
    else:
        print(yaml.safe_dump(tree, sort_keys=False), end="")


def schemas(arguments: argparse.Namespace) -> None:
    """Write the contracts for outsiders."""
    from vplog.pipeline import pipeline_schema
    from vplog.results.contracts import write_schemas

    _folder(arguments.output)
    written = [str(path) for path in write_schemas(arguments.output, pipeline_schema())]
    if arguments.json:
        _print_json({"written": written})
    else:
        print("\n".join(written))


def _folder(path: Path) -> None:
    from vplog.errors import ResultError

    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultError(f"Cannot make the folder {path}: {error.strerror}. Choose another with -o.") from None


def demo(arguments: argparse.Namespace) -> None:
    """Render a small drive, run on it, evaluate it."""
    from vplog.demo import DemoSettings, make_drive
    from vplog.evaluation import evaluate as evaluate_run
    from vplog.pipeline import run as run_pipeline

    pipeline = _pipeline(arguments)
    _folder(arguments.output)
    with _Progress(arguments) as progress:
        progress("render", 0, 1)
        drive = make_drive(arguments.output / "drive", DemoSettings(), arguments.threads)
        progress("render", 1, 1)
        done = run_pipeline(drive.log, arguments.output / "run", pipeline, threads=arguments.threads, progress=progress)
    found = evaluate_run(arguments.output / "run", str(drive.truth))
    if arguments.json:
        _print_json({"drive": str(drive.log), "truth": str(drive.truth), "run": done.record, "evaluation": found})
        return
    _print_run(arguments.output / "run", done.record)
    print(_DEMO_NEXT)
    _print_evaluation(found)


class _Progress:
    """Bars with an ETA on a terminal's stderr; silence elsewhere."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
        from rich.progress import TimeRemainingColumn as Eta

        self._tasks: dict[str, Any] = {}
        self._bars = Progress(
            TextColumn("{task.description:<18}", markup=False),
            BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), Eta(),
            console=_console(sys.stderr), disable=arguments.json or not sys.stderr.isatty(),
        )  # fmt: skip

    def __enter__(self) -> _Progress:
        self._bars.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._bars.stop()

    def __call__(self, stage: str, done: int, total: int) -> None:
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total)
        self._bars.update(self._tasks[stage], completed=done, total=total)


def _console(stream: Any) -> Console:
    from rich.console import Console

    return Console(file=stream, width=None if stream.isatty() else 160)


def _print_json(tree: dict[str, Any]) -> None:
    from vplog.results.run_record import plain

    print(json.dumps(plain(tree), indent=2, ensure_ascii=False, allow_nan=False))


def _pipeline(arguments: argparse.Namespace) -> Pipeline:
    from vplog.pipeline import load_pipeline

    return load_pipeline(arguments.pipeline, arguments.set)


def _topics(arguments: argparse.Namespace) -> TopicChoice:
    from vplog.logs import TopicChoice

    return TopicChoice(
        image=arguments.image_topic,
        depth=arguments.depth_topic,
        camera_info=arguments.camera_info_topic,
        odometry=arguments.odometry_topic,
        gps=arguments.gps_topic,
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="vplog", description=vplog.__doc__)
    parser.add_argument("--version", action="version", version=f"vplog {vplog.__version__}")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--json", action="store_true", help="print one JSON object")
    common.add_argument("--debug", action="store_true", help="show the traceback of an error")
    topics = argparse.ArgumentParser(add_help=False)
    for role in ("image", "depth", "camera-info", "odometry", "gps"):
        topics.add_argument(f"--{role}-topic", metavar="TOPIC", help=f"use this {role} topic")
    threads = argparse.ArgumentParser(add_help=False)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads.add_argument(
        "--threads", type=_at_least_one, default=cores, metavar="N", help="workers (default: all cores)"
    )
    settings = argparse.ArgumentParser(add_help=False)
    settings.add_argument("--pipeline", default="default", metavar="P", help="shipped name or .yaml file")
    settings.add_argument("--set", action="append", default=[], metavar="A.B=C", help="change one setting; repeatable")
    verbs = parser.add_subparsers(title="verbs", required=True, metavar="VERB")

    def add(name: str, verb: Verb, *parents: argparse.ArgumentParser) -> argparse.ArgumentParser:
        text = verb.__doc__ or ""
        sub = verbs.add_parser(
            name, help=text[0].lower() + text[1:].rstrip("."), description=text, parents=[common, *parents]
        )
        sub.set_defaults(verb=verb)
        return sub

    def output(sub: argparse.ArgumentParser, text: str) -> None:
        sub.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help=text)

    sub = add("info", info, topics)
    sub.add_argument("log", type=Path, metavar="LOG")
    sub = add("library", library, topics, threads, settings)
    sub.add_argument("logs", type=Path, nargs="+", metavar="LOG")
    output(sub, "folder of the library")
    sub = add("run", run, topics, threads, settings)
    sub.add_argument("logs", type=Path, nargs="+", metavar="LOG")
    output(sub, "run folder")
    sub.add_argument("--library", type=Path, metavar="LIB", help="reference library (default: made from the drive)")
    sub = add("evaluate", evaluate, topics)
    sub.add_argument("run", type=Path, metavar="RUN")
    sub.add_argument("--truth", required=True, metavar="FILE.tum|gps", help="TUM file, or the log's own GPS")
    sub = add("compare", compare, topics, threads, settings)
    _add_comparison(sub)
    sub = add("demo", demo, threads, settings)
    output(sub, "folder of the drive and the run")
    sub = add("schemas", schemas)
    sub.add_argument(
        "-o", "--output", type=Path, default=Path("schemas"), metavar="OUT", help="folder (default: schemas)"
    )
    add("config", config, settings)
    return parser


def _add_comparison(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("query", type=Path, metavar="QUERY", help="drive whose frames are looked for")
    sub.add_argument("map", type=Path, nargs="?", metavar="MAP", help="drive they are looked for in (default: QUERY)")
    sub.add_argument(
        "--methods", required=True, metavar="A,B", help="recognisers or pipelines, each with :setting=value as needed"
    )
    sub.add_argument(
        "--truth",
        required=True,
        metavar="FILE.csv|index|FILE.tum[,MAPFILE.tum]|poses|gps",
        help="pairs `query,match`, frame i is frame i, poses in one frame, the odometry of the drives, or their GPS",
    )
    sub.add_argument("--tolerance", type=_at_least(0), metavar="N", help="index: frames either side (default: 0)")
    sub.add_argument("--distance-m", type=_positive, metavar="M", help="poses, gps: same place within (default: 6)")
    sub.add_argument("--heading-deg", type=_positive, metavar="DEG", help="poses: and turned by less (default: 45)")
    sub.add_argument(
        "--min-gap", type=_at_least_one, metavar="N", help="a drive against itself: matches are N frames older or more"
    )
    sub.add_argument("--sequence", type=_at_least_one, metavar="L", help="also match sequences of L frames")
    sub.add_argument("--library", type=Path, metavar="LOG|LIB", help="reference images for all methods (default: MAP)")
    sub.add_argument("--library-size", type=_at_least_one, default=100, metavar="L", help="of a drive (default: 100)")
    sub.add_argument("--library-seed", type=_at_least(0), default=0, metavar="S", help="of their choice (default: 0)")
    sub.add_argument("-o", "--output", type=Path, metavar="OUT", help="folder for compare.json, scores and curves")


def _at_least(least: int) -> Callable[[str], int]:
    def whole_number(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"must be {least} or more")
        if value > _MOST:
            raise argparse.ArgumentTypeError(f"must be {_MOST} or less")
        return value

    return whole_number


def _at_least_one(text: str) -> int:
    return _at_least(1)(text)


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError("must be more than 0")
    return value
