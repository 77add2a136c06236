"""What users read: whole sentences in the field's words, of one line, that advise nothing which destroys."""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path
from typing import TYPE_CHECKING

import vplog
from vplog import errors

if TYPE_CHECKING:
    from collections.abc import Iterator

PACKAGE = Path(vplog.__file__).parent
PRIVATE = re.compile(
    r"\b(anew|told|unasked|believe[ds]?|walk(s|ed)?|(its|their) say|no sound|as it lies|held against|gone on with|"
    r"come again|nothing counts)\b"
)
"""Words of ours where the field has its own: again, given, accepted, traversal, weight, valid, checked."""
ADVICE = re.compile(
    r"(^|[.:,] )(Remove|Delete|Overwrite)\b|([:,]|\band|\bor) (remove|delete|overwrite)\b|rm -r|Take .* out"
)
ENDS = re.compile(r"([.?]|\{\}|-o [A-Z]+|LIB|FILE\.\w+|vplog \w+( \{\}/DRIVE)?|--\S+( \S+)?|pip install .*)$")
"""A full stop, a value that ends with one, or a command to copy."""


def text_of(node: ast.expr) -> str | None:
    """The text of a string with `{}` for each value, None of another expression."""
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else None


@functools.cache
def nodes() -> list[tuple[str, list[ast.AST]]]:
    """All of every file of the package."""
    files = sorted(PACKAGE.rglob("*.py"))
    return [(file.relative_to(PACKAGE).as_posix(), [*ast.walk(ast.parse(file.read_bytes()))]) for file in files]


def messages() -> Iterator[tuple[str, str]]:
    """Every text of three words or more that is not a docstring, by its file."""
    for file, tree in nodes():
        said = {id(node.value) for node in tree if isinstance(node, ast.Expr)}
        for node in tree:
            if isinstance(node, ast.JoinedStr):
                said |= {id(part) for part in node.values}
            if isinstance(node, ast.expr) and id(node) not in said and len((text := text_of(node) or "").split()) > 2:
                yield file, text


def raised() -> Iterator[tuple[str, str]]:
    """The sentence of every error of the package's tree that is raised with one, by its file."""
    known = {name for name, kind in vars(errors).items() if isinstance(kind, type)}
    for file, tree in nodes():
        for node in tree:
            name = node.func.id if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) else ""
            if isinstance(node, ast.Call) and name in known and node.args and (text := text_of(node.args[0])):
                yield file, text


def test_the_rules_find_what_they_forbid() -> None:
    assert PRIVATE.search("Run `vplog run` again to write it anew.")
    assert ADVICE.search("The index is damaged. Remove it.")
    assert not ENDS.search("There is no network")


def test_no_message_uses_a_private_word() -> None:
    assert [(file, text) for file, text in messages() if PRIVATE.search(text)] == []


def test_no_message_advises_to_destroy() -> None:
    assert [(file, text) for file, text in messages() if ADVICE.search(text)] == []


def test_every_error_is_one_line_of_whole_sentences() -> None:
    found = list(raised())
    assert len(found) > 200
    assert [(file, text) for file, text in found if "\n" in text or "  " in text or not ENDS.search(text)] == []
