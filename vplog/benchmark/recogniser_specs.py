"""Recognisers by the names that users give them."""

from __future__ import annotations

import re
import typing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog.errors import SettingsError, nearest
from vplog.pipeline import load_pipeline
from vplog.places import PlaceSettings
from vplog.settings import override

if TYPE_CHECKING:
    from collections.abc import Iterable

    from vplog.pipeline import Pipeline


def known_methods() -> dict[str, Any]:
    """The recognisers by kind: the members of the union in vplog/places."""
    union = typing.get_args(PlaceSettings)[0]
    members = typing.get_args(union) or (union,)
    return {member.model_fields["kind"].default: member for member in members}


def split_methods(text: str) -> list[str]:
    """`a,b:c=[1,2]` as `a` and `b:c=[1,2]`: commas inside brackets belong to a value."""
    return [name.strip() for name in re.split(r",(?![^\[{]*[\]}])", text)]


def read_method(text: str, pipeline: Pipeline) -> Any:
    """The recogniser of `kind`, `pipeline` or `file.yaml`, each with `:setting=value` as often as wanted.

    A kind has its default settings, or the pipeline's where it is the pipeline's own. Raises SettingsError.
    """
    name, *assignments = text.split(":")
    known = known_methods()
    if name in known:
        chosen = pipeline.places if pipeline.places.kind == name else known[name]()
    else:
        try:
            chosen = load_pipeline(name).places
        except SettingsError as error:
            if Path(name).suffix in (".yaml", ".yml"):
                raise
            methods = f"Methods: {', '.join(sorted(known))}."
            raise SettingsError(f"No method {name!r}.{nearest(name, known)} {methods} {error}") from None
    tree = chosen.model_dump(mode="json")
    for assignment in assignments:
        try:
            tree = override(tree, assignment)
        except SettingsError:
            raise SettingsError(
                f"Method {text}: {assignment!r} is not a setting with a value. Write it as {name}:setting=value."
            ) from None
    return type(chosen).read(tree, f"method {text}")


def read_methods(methods: Iterable[str], pipeline: Pipeline) -> dict[str, Any]:
    names = list(methods)
    recognisers = {name: read_method(name, pipeline) for name in names}
    if not names or len(recognisers) < len(names):
        raise SettingsError(f"--methods {','.join(names)}: name each method once, and one at least.")
    return recognisers
