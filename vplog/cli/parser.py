"""Grammar of the command line: argparse with arguments anywhere among the options, whole option names and errors
that name the nearest choice; the kinds of arguments, and the options that several verbs share.
"""

from __future__ import annotations

import argparse
import errno
import inspect
import math
import os
import textwrap
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from vplog.cli.examples import EXAMPLES
from vplog.errors import VplogError, nearest
from vplog.storage.folders import is_unicode
from vplog.storage.urls import printable, without_secrets

if TYPE_CHECKING:
    from vplog.logs import TopicChoice
    from vplog.pipeline import Pipeline


STDOUT = Path("-")
_ROLES = ("image", "depth", "right", "camera-info", "odometry", "gps", "imu")
_DASHES = "\u2013\u2014\u2212"
"""Dashes that text editors replace two hyphens with."""
_MOST = 10**9
"""Largest count an option may have: far above any drive, and whole in every number type."""


class _Help(argparse.HelpFormatter):
    """Help wrapped between words alone: names and options with hyphens are whole."""

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(" ".join(text.split()), max(width, 20), break_on_hyphens=False, break_long_words=False)


class Parser(argparse.ArgumentParser):
    """The command line or one verb of it. Options are written in full: what abbreviates one may mean two later."""

    def __init__(self, *args: Any, family: list[Parser] | None = None, **options: Any) -> None:
        """`family` collects the parsers of one command line, to tell which verb a misplaced option belongs to."""
        super().__init__(*args, allow_abbrev=False, formatter_class=_Help, **options)
        self.epilog = f"example: {EXAMPLES[self.prog]}" if self.prog in EXAMPLES else None
        self._family = [] if family is None else family
        self._family.append(self)
        self._intermixing, self._brief_usage = False, ""
        self._words: Sequence[str] = ()

    def add_subparsers(self, **options: Any) -> Any:
        made_by: Any = partial(Parser, family=self._family)
        return super().add_subparsers(parser_class=made_by, **options)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """A verb takes its arguments before, between and behind its options."""
        if self._intermixing or args is None:
            return super().parse_known_args(args, namespace)
        self._words = args
        verbs = self._subparsers is not None
        self._refuse_unknown(args[:1] if verbs else takewhile("--".__ne__, args))
        if verbs or "--" in args:
            return super().parse_known_args(args, namespace)
        self._intermixing, self._brief_usage = True, self._required_usage()  # which intermixing hides parts of
        try:
            namespace, extra = self.parse_known_intermixed_args(args, namespace)
        finally:
            self._intermixing = False
        if extra:
            self.error(f"one argument too many: {extra[0]}.")
        return namespace, []

    def _refuse_unknown(self, args: Iterable[str]) -> None:
        """Before anything else is found missing: the option that was mistyped may be just that."""
        for text in args:
            name = text.partition("=")[0]
            known = self._option_string_actions
            if name.lstrip(_DASHES) != name:
                self.error(f"{name} begins with another dash. Write --{name.lstrip(_DASHES)}")
            if name[:1] != "-" or name in ("-", "--") or name in known or " " in text or _is_number(text):
                continue
            if f"-{name}" in known:  # -output is no `-o utput`
                self.error(f"no option {name}. Write it with two hyphens: -{name}.")
            if name[:2] in known and not name.startswith("--"):  # -oOUT
                continue
            others = [one.prog for one in self._family if name in one._option_string_actions]
            of_family = (f"{option} of {one.prog}" for one in self._family for option in one._option_string_actions)
            near = nearest(name, known, cutoff=0.75) or nearest(
                name, of_family, lambda one: one.split()[0], cutoff=0.75
            )
            if self._subparsers is not None and others:
                self.error(f"{name} goes after the verb: {self.prog} VERB {name}")
            where = f" It is an option of {', '.join(others[:3])}." if others else ""
            longer = [
                one for one in known if one.startswith(f"{name}-") or (name[:2] == "--" and one.endswith(name[1:]))
            ]
            meant = f" Write it in full: {', '.join(longer)}." if longer else ""
            self.error(f"no option {name}.{meant or where or near}")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is None or value in action.choices:
            return
        known = [str(one) for one in action.choices]
        near, listed = nearest(str(value), known), ", ".join(known)
        if not isinstance(action, argparse._SubParsersAction):
            raise argparse.ArgumentError(action, f"{value!r} is none of {listed}.{near}")
        inner = [one.prog for one in self._family if one.prog.endswith(f" {value}")]
        if not near and inner:
            near = f" Did you mean {' or '.join(inner)}?"
        elif not near and os.path.exists(value):  # noqa: PTH110 (false for a name that is too long)
            near = f" To look into it: {self.prog} info {value}"
        self.error(f"{value!r} is not a verb of {self.prog}.{near or f' Verbs: {listed}.'}")

    def _print_message(self, message: str, file: Any = None) -> None:
        """Before Python 3.11.4 a stream that nobody reads is an error here, and the status that of a crash."""
        with suppress(OSError):
            super()._print_message(message, file)

    def error(self, message: str) -> NoReturn:
        """The shortest usage, then what is wrong in one line; exit 2."""
        message = message.replace("ignored explicit argument", "takes no value, not")
        usage, end = self._brief_usage or self._required_usage(), "" if message.endswith((".", "?", "!")) else "."
        wrong = f"{printable(without_secrets(message, self._words))}{end}"
        self.exit(2, f"{usage}{self.prog}: error: {wrong} All options: {self.prog} --help\n")

    def _required_usage(self) -> str:
        usage = self._get_formatter()
        usage.add_usage(None, [one for one in self._actions if one.required or not one.option_strings], [])
        return usage.format_help()


def _is_number(text: str) -> bool:
    """Whether this is a negative number, or the corners of a box that begin with one."""
    try:
        float(text.partition(",")[0].partition(":")[0])
    except ValueError:
        return False
    return True


def place(text: str) -> Path:
    """A path, or a URL that is read and written as one (vplog/storage/remote_path.py)."""
    if "://" not in text:
        return _path(text)
    from vplog.storage.remote_path import located

    try:
        return located(text)
    except VplogError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _local(what: str) -> Callable[[str], Path]:
    def path(text: str) -> Path:
        if "://" in text:
            raise argparse.ArgumentTypeError(f"must be a local {what}, not {text}")
        return _path(text)

    return path


local = _local("folder")
"""A folder that is written to bit by bit, which storage by URL is not."""
local_file = _local("file")
"""A single file that is written by those who do not send what they write."""


def output_file(text: str) -> Path:
    """A single local file that is written, and no input of anything."""
    path = _replaceable(local_file(text))
    if os.path.isdir(path):  # noqa: PTH112 (false for a name that is too long)
        raise argparse.ArgumentTypeError(f"{path} is a folder: name a file")
    return path


def _replaceable(path: Path) -> Path:
    if os.path.isfile(path):  # noqa: PTH113
        from vplog.run.run_folder import check_output

        try:
            check_output(path)
        except VplogError as error:
            raise argparse.ArgumentTypeError(str(error)) from None
    return path


def output_or_stdout(text: str) -> Path:
    """A single local file or a folder, or `-`, the standard output."""
    return STDOUT if text == "-" else _replaceable(local(text))


def _path(text: str) -> Path:
    if text == "-":
        raise argparse.ArgumentTypeError("stdin and stdout cannot be used here: name a path (./- for a file named -)")
    try:
        os.stat(text)  # noqa: PTH116 (of an empty text, too)
    except (OSError, ValueError) as error:
        if getattr(error, "errno", None) == errno.ELOOP:
            raise argparse.ArgumentTypeError(
                f"{text} is a link that leads to itself: name a file or a folder"
            ) from None
    if not is_unicode(os.path.abspath(text)):  # noqa: PTH100 (links are not followed)
        raise argparse.ArgumentTypeError(f"{text}: a name on its path is not UTF-8, which records are. Rename it")
    return Path(text)


def option(
    sub: argparse._ActionsContainer,
    names: str,
    kind: Callable[[str], Any],
    metavar: str,
    text: str | None = None,
    **more: Any,
) -> None:
    """An option, or an argument, that takes a value."""
    sub.add_argument(*names.split(), type=kind, metavar=metavar, help=text, **more)


def flag(sub: argparse._ActionsContainer, name: str, text: str, dest: str | None = None) -> None:
    """An option without a value; with `dest` it switches that off."""
    sub.add_argument(
        name, action="store_false" if dest else "store_true", dest=dest or name[2:].replace("-", "_"), help=text
    )


def pipeline_of(arguments: argparse.Namespace) -> Pipeline:
    from vplog.pipeline import load_pipeline

    return load_pipeline(arguments.pipeline, arguments.set)


def call(function: Callable[..., Any], arguments: argparse.Namespace, **more: Any) -> Any:
    """Call a function with the arguments of the command that it takes by name, and with more."""
    names = inspect.signature(function).parameters
    given = vars(arguments) | {"settings": vars(arguments).get("set"), "out": vars(arguments).get("output")}
    if "topics" in names:
        given["topics"] = topics_of(arguments)
    return function(**{name: value for name, value in given.items() if name in names} | more)


def topics_of(arguments: argparse.Namespace) -> TopicChoice:
    from vplog.logs import TopicChoice

    chosen = {role.replace("-", "_"): getattr(arguments, f"{role.replace('-', '_')}_topic") for role in _ROLES}
    first, *more = chosen["image"] or [None]
    masks = dict(arguments.mask_topic)
    chosen |= {"image": first, "cameras": more or None, "mask": masks.pop("", None), "mask_topics": masks}
    others = (
        *("odometry_file", "calibration_file", "start_s", "stop_s"),
        *("wheelbase_m", "track_m", "wheel_radius_m", "camera_height_m", "gps_any_status", "image_offset_s"),
    )
    return TopicChoice(**chosen, masks=dict(arguments.mask), **{name: getattr(arguments, name) for name in others})


def topic_options() -> argparse.ArgumentParser:
    parent = argparse.ArgumentParser(add_help=False)
    topics = parent.add_argument_group("the log")
    for role in _ROLES:
        names = "--odometry --odometry-topic" if role == "odometry" else f"--{role}-topic"
        source = ", or a source: twist, gps, visual, lidar, truth" if role == "odometry" else ""
        what = f"use this {role} topic{source}"
        if role == "image":
            what = "use these images; several times for several cameras (all calibrated ones if none is given)"
        action = "append" if role == "image" else "store"
        option(topics, names, str, "TOPIC", what, dest=f"{role.replace('-', '_')}_topic", action=action)
    for name, what in (("wheelbase", "axles"), ("track", "left and right wheels"), ("wheel-radius", "hub and road")):
        option(topics, f"--{name}-m", positive, "M", f"metres between {what}, for odometry of wheels")
    text = "height of a single camera over the ground, which gives its visual odometry metres"
    option(topics, "--camera-height-m", positive, "M", text)
    option(topics, "--image-offset-s", seconds, "S", "add S seconds to the stamps of the images")
    flag(topics, "--gps-any-status", "use satellite fixes even if their status says that there is no fix")
    option(topics, "--start", not_negative, "S", "leave out images before S seconds of the log", dest="start_s")
    option(topics, "--stop", not_negative, "S", "leave out images from S seconds of the log on", dest="stop_s")
    option(topics, "--odometry-file", resolved, "FILE.tum", "use these poses as the odometry")
    text = "YAML of ROS, OpenCV, Kalibr, EuRoC, VSLAM-LAB or ORB-SLAM, KITTI's calib.txt, COLMAP's cameras"
    option(topics, "--calibration", resolved, "FILE", text, dest="calibration_file")
    text = (
        "image whose zero pixels give no features, TOPIC=FILE with several cameras; or a folder with one for each image"
    )
    option(topics, "--mask", _mask, "[TOPIC=]FILE", text, action="append", default=[])
    text = "use these masks, of an image each; TOPIC=MASKS with several cameras"
    option(topics, "--mask-topic", _mask_topic, "[TOPIC=]MASKS", text, action="append", default=[])
    return parent


def _mask(text: str) -> tuple[str, Path]:
    """Image topic, empty where none is named, and file or folder."""
    topic, given, path = text.partition("=")
    if not given or os.path.exists(text):  # noqa: PTH110
        topic, path = "", text
    return topic, resolved(path)


def _mask_topic(text: str) -> tuple[str, str]:
    """Image topic, empty where none is named, and that of its masks."""
    topic, _, masks = text.rpartition("=")
    return topic, masks


def settings_options(unless_given: str | None, called: str) -> argparse.ArgumentParser:
    """`--pipeline`, with what it is unless given, and what help calls that; and `--set`."""
    parent = argparse.ArgumentParser(add_help=False)
    settings = parent.add_argument_group("settings")
    option(settings, "--pipeline", str, "P", f"shipped name or .yaml file (default: {called})", default=unless_given)
    option(settings, "--set", str, "A.B=C", "change one setting; repeatable", action="append", default=[])
    return parent


def cache_options(sub: argparse._ActionsContainer, what: str) -> None:
    text = f"folder in which {what} (default: $VPLOG_CACHE, else ~/.cache/vplog)"
    option(sub, "--cache", local, "DIR", text)
    text = "largest size of the cache in GB; least recently used files go first, 0 keeps none (default: 20)"
    option(sub, "--cache-gb", not_negative, "GB", text)


def resolved(text: str) -> Path:
    """A file that run.json names, so that the run is understood from any folder."""
    return local_file(text).resolve()


def at_least(least: int) -> Callable[[str], int]:
    def whole_number(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if not least <= value <= _MOST:
            raise argparse.ArgumentTypeError(f"must be a whole number from {least} to {_MOST}, not {text!r}")
        return value

    return whole_number


at_least_one = at_least(1)


def number(fits: Callable[[float], bool], words: str) -> Callable[[str], float]:
    def parsed(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not fits(value):
            raise argparse.ArgumentTypeError(f"must be a number {words}, not {text!r}")
        return value

    return parsed


not_negative = number(lambda value: 0 <= value < math.inf, "of 0 or more")
positive = number(lambda value: 0 < value < math.inf, "above 0")
_MOST_OFFSET_S = 1e9
"""s; thirty years, from any clock that starts at zero to one of today."""
seconds = number(lambda value: abs(value) <= _MOST_OFFSET_S, f"between -{_MOST_OFFSET_S:g} and {_MOST_OFFSET_S:g}")
share = number(lambda value: 0 < value < 1, "between 0 and 1")
