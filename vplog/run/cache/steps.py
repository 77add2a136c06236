"""Steps of a run: plain functions, measured and found in the stage cache from outside.

    @step("describe", descriptors_codec, items=lambda state, features: len(features))
    def describe(state, features, *, execution): ...

    descriptors = do(describe, state, features)    # `do` is the Steps of the run

A result is found again by its inputs, settings among them, and the code of the step. `execution` and `steps` are given
to functions that take them, and do not change a result.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, ParamSpec, Self, TypeVar

from vplog.execution.cores import limited
from vplog.execution.execution import Execution
from vplog.execution.run_warnings import collect_warnings
from vplog.execution.timing import StageTimer
from vplog.run.cache.code_hash import code_of
from vplog.run.cache.stage_cache import AbsentError, StageCache, digest_of
from vplog.settings import Settings
from vplog.storage.json_records import key_of

if TYPE_CHECKING:
    from vplog.run.cache.codecs import Codec

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Step(Generic[T]):
    """A function with what its caching and timing need to know."""

    function: Callable[..., T]
    name: str
    """Name in run.json and in the stage cache."""
    codec: Callable[..., Codec[T]] | None
    """Makes the codec of the result from the inputs; None where nothing is cached."""
    items: Callable[..., int] | None
    """Number of items worked off, from the inputs."""
    without: frozenset[str]
    """Inputs that the key omits, as others stand for them."""

    @property
    def parameters(self) -> Iterable[str]:
        return inspect.signature(self.function).parameters

    def __call__(self, *inputs: Any, **given: Any) -> T:
        """The bare function, without caching."""
        return self.function(*inputs, **given)


def step(
    name: str,
    codec: Callable[..., Codec[T]] | None = None,
    items: Callable[..., int] | None = None,
    without: Sequence[str] = (),
) -> Callable[[Callable[..., T]], Step[T]]:
    """Declare a function as a step of runs."""
    return lambda function: Step(function, name, codec, items, frozenset(without))


class Steps:
    """The steps of one run, as they are done."""

    def __init__(
        self, drive: Path | Sequence[Path], folder: Path, execution: Execution, *, use_cache: bool = True
    ) -> None:
        """Results of the steps of `drive` are kept in `folder`. Raises ResultError where it cannot be made."""
        self.warnings: list[str] = []
        """Warnings of the run so far. What a cached step warned of is repeated when its result is found."""
        self.cache = StageCache(folder, drive, use_cache)
        self._execution, self._watch = execution, StageTimer()
        self._results: dict[str, dict[str, Any]] = {}
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._stack.enter_context(limited(self._execution.threads))
        self._stack.enter_context(self.cache)
        self.warnings = self._stack.enter_context(collect_warnings())
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    def __call__(self, one: Step[T], *inputs: Any) -> T:
        """The result of a step, from the cache or computed."""
        items = one.items(*inputs) if one.items else None
        self._execution.progress(one.name, 0, items or 1)
        with self._watch.stage(one.name, items):
            value, reused = self._result(one, one.name, inputs)
        self._execution.progress(one.name, items or 1, items or 1)
        self._results.setdefault(one.name, {"result": "reused" if reused else "computed"})
        return value

    def part(self, one: Step[T], *inputs: Any) -> T:
        """The result of a step that is done within another."""
        return self._result(one, one.name, inputs)[0]

    def in_parts(self, one: Step[T], parts: Sequence[Sequence[Any]]) -> list[T]:
        """Results of a step on the inputs of every part, each cached by itself, so that a kill costs at most one."""
        ends = [0, *accumulate(one.items(*inputs) if one.items else 1 for inputs in parts)]
        found = [
            self._result(one, f"{one.name}-{number:06d}", inputs, self._execution.part(before, ends[-1]))
            for number, (before, inputs) in enumerate(zip(ends, parts, strict=False))
        ]
        self.count(one.name, len(found), sum(reused for _, reused in found))
        return [value for value, _ in found]

    def count(self, name: str, parts: int, reused: int) -> None:
        """Record of a step in parts how many of them were found."""
        before = self._results.get(name, {})
        parts, reused = parts + before.get("parts", 0), reused + before.get("parts_reused", 0)
        result = "computed" if not reused else "reused" if reused == parts else "partly reused"
        self._results[name] = {"result": result, "parts": parts, "parts_reused": reused}

    def record(self) -> dict[str, Any]:
        """Stages and totals as run.json has them."""
        stages = {
            name: {**self._results.get(name, {"result": "computed"}), **it} for name, it in self._watch.stages.items()
        }
        return {"stages": stages, "totals": self._watch.totals()}

    def _result(
        self, one: Step[T], name: str, inputs: Sequence[Any], execution: Execution | None = None
    ) -> tuple[T, bool]:
        given = {"execution": execution or self._execution, "steps": self}
        given = {key: value for key, value in given.items() if key in one.parameters}
        if one.codec is None:
            return one.function(*inputs, **given), False
        codec, key = one.codec(*inputs), _key(one, inputs)
        try:
            return self.cache.find(name, key, codec), True
        except AbsentError:
            before = len(self.warnings)
            value = one.function(*inputs, **given)
            self.cache.store(name, key, self.warnings[before:], codec.to_bytes(value))
            return value, False


def _key(one: Step[Any], inputs: Sequence[Any]) -> str:
    """sha256 over all that the result of a step depends on."""
    values = [value for name, value in zip(one.parameters, inputs, strict=False) if name not in one.without]
    methods = {
        type(value).__module__ for value in values if isinstance(value, Settings) or hasattr(value, "arrow_type")
    }
    code = code_of("vplog.run.cache.codecs", one.function.__module__, *sorted(methods))
    return key_of({"step": one.name, "inputs": [digest_of(value) for value in values], **code})
