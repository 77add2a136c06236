"""Recognisers of other packages, by entry point. None is imported unless it is named.

[project.entry-points."vplog.recognisers"]
mine = "my_package.recogniser:MineSettings"
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from vplog.data import Reference
from vplog.errors import SettingsError, nearest
from vplog.execution.execution import Execution
from vplog.settings import Settings
from vplog.stages import PlaceState

GROUP = "vplog.recognisers"


def plugin_names() -> list[str]:
    """Names of the recognisers of installed packages, by their metadata alone."""
    return sorted({one.name for one in entry_points(group=GROUP)})


class PluginSettings(Settings):
    """A recogniser of another package. In a pipeline its own name is its `kind`, beside its own settings."""

    kind: Literal["plugin"] = "plugin"
    """Stands for the name."""
    name: str = ""
    """Name of its entry point in the group `vplog.recognisers`."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Its own settings."""

    def recogniser(self) -> Any:
        """Its own settings object. Raises SettingsError where there is none of this name, or it cannot be imported."""
        made = _imported(_entry_point(self.name))
        return made.read({"kind": self.name, **self.settings}, f"plug-in {self.name}")

    @property
    def modules(self) -> tuple[str, ...]:
        """Names of the modules whose code its results depend on. Raises SettingsError as `recogniser`."""
        return (type(self.recogniser()).__module__,)

    def learn(self, references: Iterable[Reference], execution: Execution) -> PlaceState:
        """The state that its own settings learn from the references."""
        return self.recogniser().learn(references, execution)

    def load(self, folder: Path, execution: Execution) -> PlaceState:
        """A library that it saved."""
        return self.recogniser().load(folder, execution)


def as_plugin(tree: Any, known: Iterable[str]) -> Any:
    """Settings of a recogniser whose `kind` is none of the known ones, but a plug-in's, as those of PluginSettings."""
    kind = tree.get("kind") if isinstance(tree, dict) else None
    if not isinstance(kind, str) or kind in known or kind not in plugin_names():
        return tree
    return {"kind": "plugin", "name": kind, "settings": {name: value for name, value in tree.items() if name != "kind"}}


def _entry_point(name: str) -> EntryPoint:
    found = list({one.value: one for one in entry_points(group=GROUP, name=name)}.values())
    if not found:
        names = plugin_names()
        there = f"Installed: {', '.join(names)}." if names else "None is installed."
        raise SettingsError(f"No plug-in {name!r} in the group {GROUP}.{nearest(name, names)} {there}")
    if len(found) > 1:
        owners = " and ".join(sorted(_owner(one) for one in found))
        raise SettingsError(f"{owners} both have a plug-in {name}. Uninstall one of them.")
    return found[0]


def _imported(point: EntryPoint) -> type[Settings]:
    """Raises SettingsError where it is no recogniser."""
    where = f"The plug-in {point.name} of {_owner(point)} ({point.value})"
    try:
        made = point.load()
    except Exception as error:  # code of strangers: whatever it raises
        why = (str(error).splitlines() or [""])[0][:200].rstrip(".")
        raise SettingsError(f"{where} cannot be imported: {type(error).__name__}: {why}. Install it again.") from None
    if not (isinstance(made, type) and issubclass(made, Settings) and {"learn", "load"} <= set(dir(made))):
        raise SettingsError(f"{where} is no subclass of vplog.settings.Settings with learn and load.")
    kind = made.model_fields.get("kind")
    if kind is None or kind.default != point.name:
        raise SettingsError(f"{where} has no field `kind` whose default is {point.name!r}.")
    return made


def _owner(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else "a package"
