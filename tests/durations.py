"""What every test costs, for the mark `slow` and the order of the files: CPU seconds, which another load of the machine
hardly changes."""

from __future__ import annotations

import json
import resource
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable

FILE = Path(__file__).with_suffix(".json")
"""CPU seconds by test function: all its cases, the processes that they start and have ended, and its share of the
fixtures that it has in common with others."""
SLOW_S = 0.2
"""From here on a test is `slow`: the others together take a minute and a half on two cores."""
_NOTED_S = 0.1


def known() -> dict[str, float]:
    return json.loads(FILE.read_text(encoding="utf-8"))


def by_file(functions: dict[str, float]) -> Counter[str]:
    files: Counter[str] = Counter()
    for name, seconds in functions.items():
        files[name.partition("::")[0]] += seconds  # type: ignore[assignment]
    return files


class Recorder:
    """Measures tests in the process that runs them; the one that started the processes writes the file."""

    def __init__(self) -> None:
        self.functions: Counter[str] = Counter()
        self.fixtures: Counter[str] = Counter()
        """Those of more than one function, by the folder or file and name."""
        self.users: dict[str, list[str]] = {}
        """Functions that use each of these fixtures, once for each case."""

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Generator[None, Any, Any]:
        began = _cpu_s()
        made = yield
        if fixturedef.scope != "function":
            self.fixtures[_name(fixturedef)] += _cpu_s() - began  # type: ignore[assignment]
        return made

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Function) -> Generator[None, Any, Any]:
        began, shared = _cpu_s(), self.fixtures.total()
        done = yield
        function = item.nodeid.partition("[")[0]
        self.functions[function] += _cpu_s() - began - (self.fixtures.total() - shared)  # type: ignore[assignment]
        for definitions in item._fixtureinfo.name2fixturedefs.values():
            self.users.setdefault(_name(definitions[-1]), []).append(function)
        return done

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        """Adds what a worker process of pytest-xdist measured."""
        functions, fixtures, users = node.workeroutput.get("durations", ({}, {}, {}))
        self.functions.update(functions)
        self.fixtures.update(fixtures)
        for fixture, names in users.items():
            self.users.setdefault(fixture, []).extend(names)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        output = getattr(session.config, "workeroutput", None)
        if output is not None:
            output["durations"] = (dict(self.functions), dict(self.fixtures), self.users)
        else:
            self._write()

    def _write(self) -> None:
        """Files of which no test ran keep their numbers."""
        cost = Counter(self.functions)
        for fixture, seconds in self.fixtures.items():
            for function in self.users.get(fixture, ()):
                cost[function] += seconds / len(self.users[fixture])  # type: ignore[assignment]
        ran = {name.partition("::")[0] for name in cost}
        top = FILE.parents[1]
        kept = {file for name in known() if (top / (file := name.partition("::")[0])).exists()} - ran
        others = {name: s for name, s in known().items() if name.partition("::")[0] in kept}
        noted = {name: round(seconds, 1) for name, seconds in cost.items() if seconds > _NOTED_S}
        FILE.write_text(json.dumps(dict(sorted({**others, **noted}.items())), indent=0) + "\n", encoding="utf-8")


def _name(fixture: pytest.FixtureDef[Any]) -> str:
    return f"{fixture.baseid}::{fixture.argname}"


def _cpu_s() -> float:
    kinds: Iterable[int] = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(used.ru_utime + used.ru_stime for used in map(resource.getrusage, kinds))
