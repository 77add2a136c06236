"""Warnings reach the record of the run that a thread works for, and no other."""

from __future__ import annotations

import logging
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import pytest

import vplog
from vplog.execution.execution import Execution
from vplog.execution.run_warnings import collect_warnings, warn
from vplog.run.cache.codecs import json_codec
from vplog.run.cache.steps import Steps, step

if TYPE_CHECKING:
    from pathlib import Path

QUICK = {"features.max_features": 300, "library.size": 8, "verify.calibration.pairs": 0}


def test_runs_in_two_threads_get_their_own_warnings_also_from_their_worker_threads() -> None:
    both = threading.Barrier(2)

    def work(name: str) -> list[str]:
        with collect_warnings() as warnings:
            both.wait(10)
            warn(f"{name} before")
            list(Execution(3).map(lambda item: warn(f"{name} {item}"), range(20)))
            both.wait(10)
        return warnings

    with ThreadPoolExecutor(2) as pool:
        for name, warnings in zip("AB", pool.map(work, "AB"), strict=True):
            assert sorted(warnings) == sorted([f"{name} before", *(f"{name} {item}" for item in range(20))])


def test_a_block_within_another_has_its_warnings_to_itself() -> None:
    with collect_warnings() as outer:
        warn("before")
        with collect_warnings() as inner:
            warn("within")
        warn("after")
    assert (outer, inner) == (["before", "after"], ["within"])


@pytest.mark.parametrize("disabled", [False, True])
def test_warnings_are_recorded_whatever_the_caller_does_with_logging(
    disabled: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(logging.getLogger("vplog"), "disabled", disabled)
    with collect_warnings() as warnings:
        warn("100 % poor")
    assert warnings == ["100 % poor"]
    assert caplog.messages == ([] if disabled else ["100 % poor"])


@step("warn", lambda *_: json_codec(str, str))
def warn_from_workers(name: str, *, execution: Execution) -> str:
    list(execution.map(lambda item: warn(f"{name} {item}"), range(5)))
    return name


def test_steps_of_two_threads_cache_their_own_warnings_alone(tmp_path: Path) -> None:
    """Each is computed while the other has begun and not ended; then each is found in its cache, alone."""
    both = threading.Barrier(2)
    (tmp_path / "drive.mcap").write_bytes(b"a log")

    def work(name: str, wait: bool = True) -> list[str]:
        with Steps(tmp_path / "drive.mcap", tmp_path / name, Execution(2)) as do:
            for _ in range(wait):
                both.wait(10)
            assert do(warn_from_workers, name) == name
            for _ in range(wait):
                both.wait(10)
            assert do.record()["stages"]["warn"]["result"] == ("computed" if wait else "reused")
        return sorted(do.warnings)

    expected = [[f"{name} {item}" for item in range(5)] for name in "AB"]
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(work, "AB")) == expected
    assert [work(name, wait=False) for name in "AB"] == expected


def test_a_damaged_cache_is_no_warning_of_a_cached_step(tmp_path: Path) -> None:
    """A step with another inside: the file of the inner one is damaged when the outer one is computed."""

    @step("outer", lambda *_: json_codec(str, str))
    def outer(name: str, *, steps: Steps) -> str:
        return steps.part(warn_from_workers, name)

    (tmp_path / "drive.mcap").write_bytes(b"a log")
    for said in (False, True, False):
        with Steps(tmp_path / "drive.mcap", tmp_path / "cache", Execution(2)) as do:
            do(outer, "A")
        assert sorted(do.warnings) == [f"A {item}" for item in range(5)]
        assert bool(do.cache.problems) == said
        if not said:
            next((tmp_path / "cache").glob("warn*")).write_bytes(b"damaged")
            next((tmp_path / "cache").glob("outer*")).unlink()


def test_concurrent_runs_have_the_warnings_of_a_run_alone(tiny_drives: list[Path], tmp_path: Path) -> None:
    """The same drives one after the other, then at the same time, then again from their caches."""
    both = threading.Barrier(2)
    topics: list[dict[str, Any]] = [{"camera_height_m": 1.5}, {}]
    settings = [QUICK, {**QUICK, "features.max_megapixels": 0.005}]

    def run(out: str, number: int, wait: bool = False) -> list[str]:
        def progress(stage: str, done: int, _total: int) -> None:
            if wait and stage in ("read", "describe") and not done:
                both.wait(60)

        log = tiny_drives[number] / "drive.mcap"
        options: dict[str, Any] = {"settings": settings[number], "topics": topics[number], "threads": 2}
        return vplog.run(log, tmp_path / f"{out}{number}", **options, progress=progress).record["warnings"]

    alone = [run("alone", number) for number in range(2)]
    assert all(alone)
    assert not set(alone[0]) & set(alone[1])
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(lambda number: run("together", number, wait=True), range(2))) == alone
    assert [run("together", number) for number in range(2)] == alone
