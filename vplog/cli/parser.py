"""argparse with arguments anywhere among the options, whole option names, and errors that name the nearest choice."""

from __future__ import annotations

import argparse
from contextlib import suppress
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from vplog.errors import nearest
from vplog.storage.urls import without_secrets

if TYPE_CHECKING:
    from collections.abc import Iterable


class Parser(argparse.ArgumentParser):
    """The command line or one verb of it. Options are written in full: what abbreviates one may mean two later."""

    def __init__(self, *args: Any, family: list[Parser] | None = None, **options: Any) -> None:
        """`family` collects the parsers of one command line, to tell which verb a misplaced option belongs to."""
        super().__init__(*args, allow_abbrev=False, **options)
        self._family = [] if family is None else family
        self._family.append(self)
        self._intermixing, self._brief_usage = False, ""

    def add_subparsers(self, **options: Any) -> Any:
        made_by: Any = partial(Parser, family=self._family)
        return super().add_subparsers(parser_class=made_by, **options)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """A verb takes its arguments before, between and behind its options."""
        if self._intermixing or args is None:
            return super().parse_known_args(args, namespace)
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
            short = name[:2] in known and not name.startswith("--")  # -oOUT
            if name[:1] != "-" or name in ("-", "--") or name in known or short or " " in text or _is_number(text):
                continue
            others = [one.prog for one in self._family if name in one._option_string_actions]
            near = nearest(name, known, cutoff=0.75)
            if self._subparsers is not None and others:
                self.error(f"{name} goes after the verb: {self.prog} VERB {name}")
            where = f" It is an option of {', '.join(others[:3])}." if others else ""
            longer = [one for one in known if one.startswith(f"{name}-")]
            meant = f" Write it in full: {', '.join(longer)}." if longer else ""
            self.error(f"no option {name}.{meant or where or near}")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is None or value in action.choices:
            return
        known = [str(one) for one in action.choices]
        near, listed = nearest(str(value), known), ", ".join(known)
        if not isinstance(action, argparse._SubParsersAction):
            raise argparse.ArgumentError(action, f"{value!r} is none of {listed}.{near}")
        if not near and Path(value).exists():
            near = f" To look into it: {self.prog} info {value}"
        self.error(f"{value!r} is no verb of {self.prog}.{near or f' Verbs: {listed}.'}")

    def _print_message(self, message: str, file: Any = None) -> None:
        """Before Python 3.11.4 a stream that nobody reads is an error here, and the status that of a crash."""
        with suppress(OSError):
            super()._print_message(message, file)

    def error(self, message: str) -> NoReturn:
        """The shortest usage, then what is wrong in one line; exit 2."""
        usage, end = self._brief_usage or self._required_usage(), "" if message.endswith((".", "?", "!")) else "."
        self.exit(2, f"{usage}{self.prog}: error: {without_secrets(message)}{end} All options: {self.prog} --help\n")

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
