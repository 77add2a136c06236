"""Settings: frozen pydantic models, read from flat YAML that holds only what differs from the defaults in code."""

from __future__ import annotations

import ast
import reprlib
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import cache, partial
from inspect import cleandoc, getsource
from itertools import pairwise
from operator import eq
from pathlib import Path
from textwrap import dedent
from typing import Annotated, Any, ClassVar, Self

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError

from vplog.errors import SettingsError, nearest, nearest_path

_NOT_YAML = (yaml.YAMLError, ValueError, RecursionError)
"""Errors of the parser: a date like 2024-13-45 or too long a number is a ValueError, deep nesting ends the stack."""

FileName = Annotated[str, AfterValidator(lambda name: str(Path(name).absolute()) if name else "")]
"""A file as an absolute path; empty where none is given."""

_A_SETTING = "`vplog config` prints every setting."
_A_FILE = "`vplog config` prints a pipeline file."


def _describe(schema: dict[str, Any], settings: type[BaseModel]) -> None:
    """Adds the sentences below the fields to their JSON schema; pydantic would read every source at each start."""
    for one in settings.__mro__[-3::-1]:  # from Settings on
        for name, sentence in _sentences(one).items():
            schema["properties"].get(name, {})["description"] = sentence


@cache
def _sentences(settings: type[BaseModel]) -> dict[str, str]:
    """The text below each field in the source, cleaned; without a source, as in a shell, nothing."""
    found = {}
    with suppress(OSError):
        for field, below in pairwise(ast.walk(ast.parse(dedent(getsource(settings))))):
            match field, below:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(sentence))):
                    found[name] = cleandoc(sentence)
    return found


class Settings(BaseModel):
    """Base of every settings object: frozen, no unknown names, one sentence below each field."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, json_schema_extra=_describe)
    LOCATIONS: ClassVar[frozenset[str]] = frozenset()
    """Names of those that say where a file is: not they, but its content decides results."""

    def identity(self) -> dict[str, Any]:
        """The settings that results depend on, as plain values."""
        return self.model_dump(mode="json", exclude=set(self.LOCATIONS))

    @classmethod
    def read(cls, tree: dict[str, Any], where: str, assignments: Iterable[str] = ()) -> Self:
        """Validate a tree of plain values; `assignments` are the `a.b=c` that overrode values of the file `where`.

        Raises SettingsError for the first value that does not fit: its place, its name, what is allowed, the nearest
        name.
        """
        try:
            return cls.model_validate(tree)
        except ValidationError as error:
            name, text = _explain(error.errors()[0], _schema(cls))
            parts = name.split(".")
            set_by = [one for one in assignments if all(map(eq, one.partition("=")[0].split("."), parts))]
            place = f"--set {set_by[-1]}" if set_by else where
            remedy = "" if _A_SETTING in text else f" {_A_SETTING}"  # of a file that these settings name
            raise SettingsError(f"{place}: {text}{remedy}") from None


@cache
def _schema(settings: type[Settings]) -> dict[str, Any]:
    return settings.model_json_schema()


def _explain(error: Any, schema: dict[str, Any]) -> tuple[str, str]:
    """Dotted name of the setting that an error of pydantic is about, and what is wrong with it, in sentences."""
    path, node, group = _located(error["loc"], schema)
    kind, value = error["type"], error["input"]
    if kind.startswith("union_tag"):  # the group's `kind` names none of its methods
        path, value = [*path, "kind"], value.get("kind") if isinstance(value, dict) else None
        node = {"enum": sorted(node["discriminator"]["mapping"])}
    name = ".".join(path)
    if kind == "value_error":  # raised by a validator of these settings, in words
        return name, f"{name}{': ' if name else ''}{error['ctx']['error']}."
    if not node:
        return name, f"{name} is no setting.{_other_names(path, list(group.get('properties', {})), schema)}"
    given = "null" if value is None else reprlib.repr(value)[:80]
    near = nearest(value, map(str, node.get("enum", ()))) if isinstance(value, str) else ""
    return name, f"{name or 'it'} must be {_allowed(node)}, not {given}.{near}"


def _other_names(path: list[str], siblings: list[str], schema: dict[str, Any]) -> str:
    """The settings that may be meant by the unknown one at `path`, in a sentence: nearest, then those beside it."""
    *groups, name = path
    methods = schema["properties"].get(path[0], {}).get("discriminator", {}).get("mapping", {})
    kinds = [kind for kind, at in methods.items() if name in _resolved({"$ref": at}, schema)["properties"]]
    if kinds and len(path) == 2:
        return f" It belongs to {path[0]}.kind={' or '.join(kinds)}."
    names = [".".join([*groups, one]) for one in siblings]
    near = nearest(name, names, key=_last) or nearest(name, _names(schema), key=_last, cutoff=0.8)
    return near or f" Settings{' of ' if groups else ''}{'.'.join(groups)}: {', '.join(siblings)}."


def _last(name: str) -> str:
    return name.rsplit(".", 1)[-1]


def _located(loc: Sequence[str | int], schema: dict[str, Any]) -> tuple[list[str], dict[str, Any], dict[str, Any]]:
    """Names on the way to a setting, its JSON schema (empty where it has none), and that of the group it is in."""
    path, node, group = [], schema, schema
    for part in loc:
        if "discriminator" in node and part in node["discriminator"]["mapping"]:  # the method, which no name holds
            node = _resolved({"$ref": node["discriminator"]["mapping"][part]}, schema)
        elif "anyOf" not in node and part != "[key]":
            group, inner = node, node.get("items") if isinstance(part, int) else node.get("properties", {}).get(part)
            path, node = [*path, str(part)], _resolved(inner or {}, schema)
    return path, node, group


def _resolved(node: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    return schema["$defs"][node["$ref"].rsplit("/", 1)[1]] if "$ref" in node else node


def _names(schema: dict[str, Any]) -> list[str]:
    """Dotted names of the settings in the groups of a schema."""
    names = []
    for group, node in schema.get("properties", {}).items():
        members = map(partial(_resolved, schema=schema), node.get("oneOf", [node]))
        names += [f"{group}.{name}" for member in members for name in member.get("properties", {})]
    return list(dict.fromkeys(names))


_TYPES = {
    "integer": "a whole number", "number": "a number", "boolean": "true or false", "string": "text", "null": "null",
    "array": "a list",
}  # fmt: skip
_LIMITS = {
    "minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below",
    "minItems": "of length at least",
}  # fmt: skip


def _allowed(node: dict[str, Any]) -> str:
    """Values that a JSON schema allows, in words."""
    if "anyOf" in node:
        return " or ".join(_allowed(one) for one in node["anyOf"])
    if "enum" in node or "const" in node:
        return f"one of {', '.join(map(str, node.get('enum', [node.get('const')])))}"
    limits = " and ".join(f"{word} {node[name]}" for name, word in _LIMITS.items() if name in node)
    items = f" in which each is {_allowed(node['items'])}" if "items" in node else ""
    kind = _TYPES.get(node.get("type", ""), "a group of settings (name: value each)")
    return f"{kind}{f' ({limits})' if limits else ''}{items}"


def commented_yaml(settings: Settings) -> str:
    """All settings as YAML, each below its sentences as a comment."""
    lines: list[str] = []
    _comment(lines, settings, "")
    return "".join(f"{line}\n" for line in lines)


def _comment(lines: list[str], settings: Settings, indent: str) -> None:
    sentences = {name: one.get("description", "") for name, one in _schema(type(settings))["properties"].items()}
    for name, value in settings:
        lines += [f"{indent}# {line}" for line in sentences.get(name, "").splitlines()]
        if isinstance(value, Settings):
            lines.append(f"{indent}{name}:")
            _comment(lines, value, f"{indent}  ")
        else:
            text = yaml.safe_dump({name: settings.model_dump(mode="json")[name]}, sort_keys=False)
            lines += [f"{indent}{line}" for line in text.splitlines()]


def explained(settings: Settings, name: str) -> dict[str, Any]:
    """One setting by its dotted name, as `places.agreement`: value, default, what is allowed, and its sentences; of a
    group its value and sentences. Raises SettingsError."""
    *groups, last = name.split(".")
    schema, group = _schema(type(settings)), settings
    for part in groups:
        inner = getattr(group, part, None) if part in type(group).model_fields else None
        if not isinstance(inner, Settings):
            known = f" Groups: {', '.join(type(settings).model_fields)}."
            near = nearest(last, _names(schema), key=_last, cutoff=0.8) or known
            raise SettingsError(f"{name} is no setting.{near} {_A_SETTING}")
        group = inner
    own = _schema(type(group))
    if last not in type(group).model_fields:
        near = _other_names([*groups, last], list(type(group).model_fields), schema)
        raise SettingsError(f"{name} is no setting.{near} {_A_SETTING}")
    node, value = own["properties"][last], group.model_dump(mode="json")[last]
    allowed = "" if isinstance(getattr(group, last), Settings) else _allowed(_resolved(node, own))
    found = {"setting": name, "value": value, "default": node.get("default", value), "allowed": allowed}
    return found | {"description": node.get("description", "")}


def load_yaml(path: Path, remedy: str = _A_FILE) -> dict[str, Any]:
    """A YAML file as a tree. Raises SettingsError, which ends with the remedy, where it is not one."""
    try:
        if path.stat().st_size > 1_000_000:  # a pipeline is a few lines; refuse what could blow up the parser
            raise SettingsError(f"{path} is larger than 1 MB, so it is no file of settings. {remedy}")
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        why = (error.strerror or error) if isinstance(error, OSError) else error
        raise SettingsError(f"Cannot read {path}: {why}. {remedy}{nearest_path(path)}") from None
    except _NOT_YAML as error:
        mark = getattr(error, "problem_mark", None)
        line = "" if mark is None else f" in line {mark.line + 1}"
        why = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise SettingsError(f"{path} is not YAML{line}: {why}. {remedy}") from None
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise SettingsError(f"{path} holds no settings (name: value each) at its top level. {remedy}")
    return tree


def override(tree: dict[str, Any], assignment: str) -> dict[str, Any]:
    """A copy of the tree with `a.b=value` set; the value is read as YAML."""
    name, equals, text = assignment.partition("=")
    if not equals or not all(name.split(".")):
        raise SettingsError(f"--set {assignment}: write it as --set stage.setting=value. {_A_SETTING}")
    try:
        value = yaml.safe_load(text)
    except _NOT_YAML:
        why = f"{reprlib.repr(text)} is not a YAML value; quote text that has brackets or colons"
        raise SettingsError(f"--set {reprlib.repr(assignment)[1:-1]}: {why}.") from None
    return _with(tree, name.split("."), value)


def _with(tree: dict[str, Any], path: list[str], value: Any) -> dict[str, Any]:
    head, *rest = path
    if not rest:
        return {**tree, head: value}
    below = tree.get(head)
    below = {} if below is None else below
    if not isinstance(below, dict):
        raise SettingsError(f"--set {'.'.join(path)}: {head} is a value, not a group of settings. {_A_SETTING}")
    return {**tree, head: _with(below, rest, value)}
