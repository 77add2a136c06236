"""Recognisers by the names that users give them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from vplog.benchmark.published_answers import AnswersSettings
from vplog.errors import SettingsError, nearest
from vplog.pipeline import Pipeline, load_pipeline
from vplog.places import KINDS
from vplog.places.plugin import PluginSettings, plugin_names
from vplog.settings import override


def split_methods(text: str) -> list[str]:
    """`a,b:c=[1,2]` as `a` and `b:c=[1,2]`: commas inside brackets belong to a value."""
    return [name.strip() for name in re.split(r",(?![^\[{]*[\]}])", text)]


def read_method(text: str, pipeline: Pipeline, others: Iterable[str] = ()) -> Any:
    """The recogniser of `kind`, `kind:FILE`, `pipeline` or `file.yaml`, each with `:setting=value` as often as wanted.

    A kind has its default settings, or the pipeline's where it is the pipeline's own. Raises SettingsError, which names
    `others` among the methods.
    """
    name, *assignments = text.split(":")
    known = KINDS
    location = next(iter(known[name].LOCATIONS), "") if name in known else ""
    cut = next((i for i, one in enumerate(assignments) if re.match(r"[a-z_0-9.]+=", one)), len(assignments))
    if location and cut:  # a path may hold colons
        assignments = [f"{location}={json.dumps(':'.join(assignments[:cut]))}", *assignments[cut:]]
        chosen = known[name]()  # what a file says of itself is read from it
    elif name in known:
        chosen = pipeline.places if pipeline.places.kind == name else known[name]()
    elif name in plugin_names():
        own = isinstance(pipeline.places, PluginSettings) and pipeline.places.name == name
        chosen = pipeline.places if own else PluginSettings(name=name)
    else:
        try:
            chosen = load_pipeline(name).places
        except SettingsError as error:
            if Path(name).suffix in (".yaml", ".yml"):
                raise
            names = sorted({*known, *plugin_names(), *others} - {"plugin"})
            methods = f"Methods: {', '.join(names)}."
            raise SettingsError(f"No method {name!r}.{nearest(name, names)} {methods} {error}") from None
    if isinstance(chosen, PluginSettings) and chosen.name:
        chosen = chosen.recogniser()
    tree = {"kind": chosen.kind, **chosen.model_dump(mode="json", exclude_unset=True)}
    for assignment in assignments:
        try:
            tree = override(tree, assignment)
        except SettingsError:
            raise SettingsError(
                f"Method {text}: {assignment!r} is not a setting with a value. Write it as {name}:setting=value."
            ) from None
    try:
        return type(chosen).read(tree, f"method {text}")
    except SettingsError as error:
        what, _, _ = str(error).rpartition(" `vplog config`")
        if name in plugin_names():  # its settings are its own, and named in what is said
            raise SettingsError(what) from None
        raise SettingsError(f"{what} `vplog config --set places.kind={chosen.kind}` prints them all.") from None


def read_methods(methods: Iterable[str], pipeline: Pipeline, answers: bool = False) -> dict[str, Any]:
    """The recognisers of several names, with `answers` also files of answers: `answers:FILE.csv`."""
    names = list(methods)
    recognisers: dict[str, Any] = {}
    others = ["answers"] if answers else []
    for name in names:
        kind, _, file = name.partition(":")
        recognisers[name] = AnswersSettings(file=file) if kind in others else read_method(name, pipeline, others)
    if not names or len(recognisers) < len(names):
        raise SettingsError(f"--methods {','.join(names)}: name each method once, and one at least.")
    return recognisers
