# PYTHON_ARGCOMPLETE_OK
"""The verbs: each a plain function of its arguments. The only place that prints and exits."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from vplog import api
from vplog.cli import parser, printing, results
from vplog.cli.benchmark import add_studies
from vplog.cli.maps import add_maps
from vplog.cli.parser import Parser, flag, option, place
from vplog.cli.printing import print_json, print_result, print_status
from vplog.cli.progress import Progress, events_of
from vplog.cli.results import add_results
from vplog.errors import LogError, ResultError, SettingsError, VplogError, causes, plural, was_interrupted
from vplog.execution.cores import available, limited
from vplog.execution.execution import Execution
from vplog.execution.run_warnings import collect_warnings
from vplog.storage.urls import without_secrets
from vplog.version import __version__

if TYPE_CHECKING:
    from vplog.logs import TopicChoice
    from vplog.pipeline import Pipeline

    Verb = Callable[[argparse.Namespace], None]


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Parse, run one verb, exit: 0 done, 1 a known error in one line, 2 wrong usage, 130 interrupted, 143 ended."""
    try:
        _run_verb(argv)
    finally:
        _flush()


def _run_verb(argv: Sequence[str] | None) -> NoReturn:
    # before numpy loads: every stage has its own workers, and a BLAS pool inside each would only get in their way
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    sys.stdout, sys.stderr = (stream or open(os.devnull, "w") for stream in (sys.stdout, sys.stderr))  # noqa: SIM115, PTH123 (of the process)
    words = sys.argv[1:] if argv is None else argv
    root = _parser()
    if "_ARGCOMPLETE" in os.environ:  # set by the shell's completion, of the extra `completion`
        with suppress(ImportError):
            import argcomplete

            argcomplete.autocomplete(root)  # writes the words that may follow, and exits
    arguments = root.parse_args(words)
    arguments.command = words
    arguments.shown = getattr(arguments, "output", None)  # a verb may write elsewhere first
    try:
        with (
            _interrupted_by(signal.SIGTERM),
            events_of(arguments),
            _local_copies(arguments),
            limited(getattr(arguments, "threads", None)),
        ):
            arguments.verb(arguments)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output has gone; nothing is wrong
        sys.exit(0)
    except KeyboardInterrupt as error:
        _interrupted(arguments, error)
    except VplogError as error:
        _fail(arguments, str(error))
    except MemoryError:
        _fail(arguments, "Out of memory. Use fewer --threads, or a shorter log.")
    except OSError as error:  # a full disk, a drive that went away
        _fail(
            arguments,
            f"Cannot read or write {error.filename or arguments.shown or 'a file'}: {error.strerror or error}.",
        )
    except Exception as error:  # a fault of ours: still one line, and how to see more
        if was_interrupted(error):
            _interrupted(arguments, error)
        text = " ".join(str(error).split())[:200]
        _fail(arguments, f"Internal error: {type(error).__name__}: {text}. See it with --debug.")
    sys.exit(0)


@contextmanager
def _local_copies(arguments: argparse.Namespace) -> Iterator[None]:
    """Run folders and libraries named by URL are copied for the verb; what it writes to one is sent when it is done."""
    places = {name: getattr(arguments, name, None) for name in ("run", "runs", "baseline", "library", "output")}
    if not any("://" in str(place) for place in places.values()):
        yield
        return
    from vplog.storage.remote_path import RemotePath, local_copy, local_output

    writing = arguments.verb in (results.explain, results.ask, results.report)
    beside = writing and not getattr(arguments, "no_picture", False)
    if beside and isinstance(places["run"], RemotePath) and places["output"] is None:
        raise SettingsError(f"{places['run']} is read alone, so nothing is written beside it. Name a place with -o.")

    def copied(place: Path | RemotePath) -> AbstractContextManager[Path | RemotePath]:
        """A map is read where it is."""
        return nullcontext(place) if (place / "map.json").is_file() else local_copy(place)

    with ExitStack() as stack:
        for name, place in places.items():
            if place is None:
                continue
            if name == "runs":
                arguments.runs = [stack.enter_context(copied(run)) for run in place]
            else:
                setattr(arguments, name, stack.enter_context((local_output if name == "output" else copied)(place)))
        yield


@contextmanager
def _interrupted_by(number: signal.Signals) -> Iterator[None]:
    """SIGTERM, as schedulers and containers send it, ends the verb as Ctrl-C: workers and scratch files are removed."""

    def end(*_: object) -> NoReturn:
        raise KeyboardInterrupt(number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(number, end)
    try:
        yield
    finally:
        signal.signal(number, before)


def _flush() -> None:
    """Write out stdout and stderr. What one of them does not take is dropped: the interpreter, which flushes both once
    more, would end with a status of its own (120)."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            with suppress(OSError):  # what stands in for the stream may be no file
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _interrupted(arguments: argparse.Namespace, error: BaseException) -> NoReturn:
    again = f". Go on with: vplog run --resume -o {shlex.quote(str(arguments.shown))}"
    default = f"finished results in the output folder are kept{again if getattr(arguments, 'resume', False) else ''}"
    known = getattr(error, "__notes__", [default])
    print_status(without_secrets(f"interrupted; {known[-1]}", arguments.command))
    numbers = (one.args[0] for one in causes(error) if isinstance(one, KeyboardInterrupt) and one.args)
    sys.exit(128 + next(numbers, signal.SIGINT))


def _fail(arguments: argparse.Namespace, message: str) -> NoReturn:
    if arguments.debug:
        sys.excepthook = partial(printing.print_traceback, arguments.command)
        raise  # noqa: PLE0704 (called from an except block)
    _flush()
    text = " ".join([f"error: {message}", *getattr(sys.exception(), "__notes__", [])])
    print_status(without_secrets(text, arguments.command))
    sys.exit(1)


def info(arguments: argparse.Namespace) -> None:
    """Show what is in a log, what a run would use, what is wrong, and the command to run."""
    from vplog.verbs.info import preflight

    found = preflight(arguments.log, parser.topics_of(arguments))
    if arguments.html is not None:
        from vplog.verbs.info import write_page

        write_page(arguments.html, found)
    record = found.record
    if arguments.json:
        print_json(record)
    elif not arguments.check:
        printing.print_info(record)
        if arguments.html is not None:
            print(f"page      {arguments.html}")
    elif record["ready"]:
        print(f"{arguments.log} can be run: {record['command']}")
    if arguments.check and not record["ready"]:
        instead = f" This works: {record['command']}" if record["command"] else ""
        raise LogError(f"{arguments.log} cannot be run. {' '.join(record['problems'])}{instead}")


def library(arguments: argparse.Namespace) -> None:
    """Build a reference library from frames of logs."""
    from vplog.places.library_files import read_library_record
    from vplog.run.reference_library import build_library

    pipeline = parser.pipeline_of(arguments)
    with Progress(arguments) as progress, collect_warnings() as warnings:
        state = build_library(
            arguments.logs, arguments.output, pipeline, parser.topics_of(arguments),
            Execution(arguments.threads, progress), force=arguments.force,
        )  # fmt: skip
    record = read_library_record(arguments.output)
    if arguments.json:
        print_json({"library": str(arguments.output), **record, "descriptor_bits": state.bits, "warnings": warnings})
        return
    references, features = (plural(record[f"{one}s"], one) for one in ("reference", "feature"))
    text = f"{references}, {features}, {state.bits} bits a place, hash {state.hash[:12]}"
    printing.print_line(f"{arguments.shown}:", text)
    printing.warn(warnings)
    print(f"next      vplog run LOG -o OUT --library {shlex.quote(str(arguments.shown))}")


def run(arguments: argparse.Namespace) -> None:
    """Turn a recorded drive into an optimised trajectory; several drives into one map where closures join them."""
    from vplog.pipeline import STAGES

    paths, pipeline, library, topics = _request(arguments)
    remote = "://" in str(arguments.shown)  # and `output` what is sent there
    with Progress(arguments, STAGES, arguments.output) as progress:
        found = api.run(
            paths, arguments.output, pipeline, topics=topics, library=library, one_drive=arguments.one_drive,
            cache=arguments.cache and not remote, force=arguments.force, threads=arguments.threads, progress=progress,
        ).record  # fmt: skip
    if arguments.json:
        print_json({"run": str(arguments.shown), **found})
    elif "maps" in found:
        printing.print_joint(arguments.shown, found)
    else:
        printing.print_run(arguments.shown, found)


def _request(arguments: argparse.Namespace) -> tuple[list[Path], Pipeline, Path | None, TopicChoice]:
    """Logs, settings, library and topics: those of the command, or with --resume those of the unfinished run."""
    if not arguments.resume:
        if not arguments.logs:
            arguments.refuse("the following arguments are required: LOG")
        if arguments.gps:
            arguments.set.append("gps.use=true")
        if arguments.decisions is not None:
            arguments.set.append(f"decisions.file={json.dumps(str(arguments.decisions))}")
        if arguments.false_rate is not None:
            arguments.set.append(f"false_rate.rate={arguments.false_rate!r}")
        return arguments.logs, parser.pipeline_of(arguments), arguments.library, parser.topics_of(arguments)
    from vplog.verbs.resume import resume_request

    if "://" in str(arguments.shown):
        arguments.refuse("argument --resume: a run to a URL is uploaded when finished; start it again")
    fixed = ("pipeline", "set", "library", "gps", "false_rate", "decisions", "mask", "one_drive")
    names = [name for name in vars(arguments) if name in fixed or name.endswith(("_topic", "_file", "_m", "_s"))]
    given = [name for name in names if getattr(arguments, name) not in (None, [], False, "default")]
    if given or not arguments.cache:
        name = given[0].removesuffix("_s").replace("calibration_file", "calibration") if given else "no-cache"
        arguments.refuse(f"argument --resume: a run is resumed as it began; leave out --{name.replace('_', '-')}")
    request = resume_request(arguments.output, arguments.logs)
    arguments.one_drive = not request.several
    arguments.force = True  # whether it may replace results was settled when it began
    return request.logs, request.pipeline, request.library, request.topics


def config(arguments: argparse.Namespace) -> None:
    """Print every setting of a pipeline as YAML with comments, in the form of a pipeline file, or explain one."""
    from vplog.settings import commented_yaml, explained

    pipeline = parser.pipeline_of(arguments)
    if arguments.setting is not None:
        print_result(arguments, explained(pipeline, arguments.setting), printing.print_setting)
    else:
        tree = pipeline.model_dump(mode="json")
        print_result(arguments, tree, lambda _: print(commented_yaml(pipeline), end=""))


def schemas(arguments: argparse.Namespace) -> None:
    """Write the schemas of tables, MCAP messages and settings."""
    from vplog.pipeline import pipeline_schema
    from vplog.results.contracts import write_schemas

    _folder(arguments.output)
    written = [str(path) for path in write_schemas(arguments.output, pipeline_schema())]
    print_result(arguments, {"written": written}, lambda found: print("\n".join(found["written"])))


def _folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultError(f"Cannot make the folder {path}: {error.strerror}. Choose another with -o.") from None


def demo(arguments: argparse.Namespace) -> None:
    """Render a small drive, run on it and evaluate the result."""
    from vplog.pipeline import STAGES
    from vplog.verbs.demo import DemoSettings, make_drive
    from vplog.verbs.report import report as write_report

    pipeline = parser.pipeline_of(arguments)
    _folder(arguments.output)
    out = arguments.output / "run"
    with Progress(arguments, STAGES, out) as progress:
        drive = make_drive(arguments.output / "drive", DemoSettings(), Execution(arguments.threads, progress))
        done = api.run(drive.log, out, pipeline, force=arguments.force, threads=arguments.threads, progress=progress)
    found = api.evaluate(done, drive.truth)
    write_report(out, truth=str(drive.truth))
    if arguments.json:
        print_json({"drive": str(drive.log), "truth": str(drive.truth), "run": done.record, "evaluation": found})
        return
    printing.print_run(out, done.record, drive.truth)
    printing.print_evaluation(found)


def _parser() -> argparse.ArgumentParser:
    about = "From a recorded drive to an optimised trajectory, with loop closures found by bag of bounding boxes."
    root = Parser(prog="vplog", description=about)
    root.add_argument("-V", "--version", action="version", version=f"vplog {__version__}")
    common = argparse.ArgumentParser(add_help=False)
    output_group = common.add_argument_group("output and errors")
    flag(output_group, "--json", "print one JSON object")
    flag(output_group, "--debug", "show the traceback of an error")
    option(output_group, "--events", parser.output_file, "FILE", "write progress as JSON lines, each as it happens")
    topics = parser.topic_options()
    threads = argparse.ArgumentParser(add_help=False)
    work = threads.add_argument_group("execution")
    option(work, "--threads", parser.at_least_one, "N", "threads (default: all cores)", default=available())
    settings = parser.settings_options("default", "default")
    verbs = root.add_subparsers(title="verbs", required=True, metavar="VERB")

    def group(name: str, text: str, parents: Sequence[argparse.ArgumentParser] = ()) -> argparse.ArgumentParser:
        summary = text[0].lower() + text[1:].rstrip(".")
        return verbs.add_parser(name, help=summary, description=text, parents=parents)

    def add(name: str, verb: Verb, *parents: argparse.ArgumentParser) -> argparse.ArgumentParser:
        sub = group(name, verb.__doc__ or "", [common, *parents])
        sub.set_defaults(verb=verb)
        return sub

    def output(sub: argparse.ArgumentParser, text: str) -> None:
        option(sub, "-o --output", place, "OUT", text, required=True)

    sub = add("info", info, topics)
    option(sub, "log", place, "LOG")
    flag(sub, "--check", "print one line; exit status 1 if a run would fail")
    option(sub, "--html", parser.output_file, "FILE.html", "also write an HTML page with pictures of the drive")
    sub = add("library", library, topics, threads, settings)
    option(sub, "logs", place, "LOG", nargs="+")
    output(sub, "folder of the library")
    _add_force(sub, "library")
    sub = add("run", run, topics, threads, settings)
    _add_run(sub)
    output(sub, "run folder")
    add_results(add, topics, threads)
    add_studies(add, topics, threads, settings)
    add_maps(add, group, common, topics, threads)
    sub = add("demo", demo, threads, settings)
    output(sub, "folder of the drive and the run")
    _add_force(sub)
    sub = add("schemas", schemas)
    option(sub, "-o --output", parser.local, "OUT", "folder (default: schemas)", default=Path("schemas"))
    sub = add("config", config, settings)
    option(sub, "setting", str, "SETTING", "explain this one, as places.agreement (default: print all)", nargs="?")
    sub = group("help", "Show what a verb does, and all its options.")
    sub.add_argument("words", nargs="*", metavar="VERB", help="such as `run` or `map query` (default: list the verbs)")
    sub.set_defaults(
        verb=lambda arguments: root.parse_args([*" ".join(arguments.words).split(), "--help"]), debug=False
    )
    return root


def _add_force(sub: argparse.ArgumentParser, what: str = "run") -> None:
    flag(sub, "--force", f"replace the {what} of another log in OUT")


def _add_run(sub: argparse.ArgumentParser) -> None:
    sub.set_defaults(refuse=sub.error)
    option(sub, "logs", place, "LOG", nargs="*")
    option(sub, "--library", place, "LIB", "reference library (default: made from the drive)")
    flag(sub, "--one-drive", "the logs are the parts of one recording")
    flag(sub, "--gps", "use the log's satellite fixes as constraints")
    text = "share of false closures to allow, as 0.01 (default: all verified ones)"
    option(sub, "--false-rate", parser.share, "R", text)
    option(sub, "--decisions", parser.resolved, "FILE.csv", "closures to accept, reject or add, as report.html writes")
    flag(sub, "--resume", "continue the interrupted run in OUT; needs no LOG")
    _add_force(sub)
    flag(sub, "--no-cache", "do not cache results of stages in OUT for later runs", "cache")
