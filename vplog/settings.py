"""Settings: frozen pydantic models, read from flat YAML that holds only what differs from the defaults in code."""

from __future__ import annotations

import reprlib
from typing import TYPE_CHECKING, Any, Self

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from vplog.errors import SettingsError

if TYPE_CHECKING:
    from pathlib import Path


_NOT_YAML = (yaml.YAMLError, ValueError, RecursionError)
"""What the parser raises: a date like 2024-13-45 or too long a number is a ValueError, deep nesting ends the stack."""


class Settings(BaseModel):
    """Base of every settings object: frozen, no unknown names, one sentence below each field."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)

    @classmethod
    def read(cls, tree: dict[str, Any], where: str) -> Self:
        """Check a tree of plain values. Raises SettingsError with the first thing that does not fit."""
        try:
            return cls.model_validate(tree)
        except ValidationError as error:
            first = error.errors()[0]
            name = ".".join(str(part) for part in first["loc"]) or "the top level"
            raise SettingsError(
                f"{where}: {name}: {first['msg']} (got {reprlib.repr(first['input'])[:80]}). "
                "`vplog config` prints every setting with its default."
            ) from None


def load_yaml(path: Path) -> dict[str, Any]:
    """A YAML file as a tree. Raises SettingsError where it is not one."""
    try:
        if path.stat().st_size > 1_000_000:  # a pipeline is a few lines; refuse what could blow up the parser
            raise SettingsError(f"{path} is larger than 1 MB, so it is not a pipeline file.")
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(f"Cannot read {path}: {error}.") from None
    except _NOT_YAML as error:
        raise SettingsError(f"{path} is not YAML: {str(error).splitlines()[0]}.") from None
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise SettingsError(f"{path} must be a mapping of settings at its top level.")
    return tree


def override(tree: dict[str, Any], assignment: str) -> dict[str, Any]:
    """A copy of the tree with `a.b=value` set; the value is read as YAML."""
    name, equals, text = assignment.partition("=")
    if not equals or not all(name.split(".")):
        raise SettingsError(f"--set {assignment}: write it as --set stage.setting=value.")
    try:
        value = yaml.safe_load(text)
    except _NOT_YAML:
        raise SettingsError(f"--set {assignment}: {text!r} is not a YAML value.") from None
    return _with(tree, name.split("."), value)


def _with(tree: dict[str, Any], path: list[str], value: Any) -> dict[str, Any]:
    head, *rest = path
    if not rest:
        return {**tree, head: value}
    below = tree.get(head)
    below = {} if below is None else below
    if not isinstance(below, dict):
        raise SettingsError(f"--set: {head} is a value, not a group of settings.")
    return {**tree, head: _with(below, rest, value)}
