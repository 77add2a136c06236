"""Which frames become references: at random as the paper, or evenly."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vplog import logs
from vplog.errors import SettingsError
from vplog.execution.execution import Execution
from vplog.pipeline import load_pipeline, run
from vplog.places.library_files import load_references
from vplog.places.reference_choice import LEAST_SIZE, PAPER_SIZE, LibrarySettings, choose, evenly
from vplog.run.reference_library import build_library

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.verbs.demo.record import Demo

COUNTS = st.integers(1, 3000)
SIZES = st.one_of(st.none(), st.integers(1, 400))
QUICK = ("library.choose=coverage", "features.max_features=250", "features.max_megapixels=0.06")
"""Fewer features, so that the drive is looked at soon."""


@given(COUNTS, SIZES, st.sampled_from(["random", "spread"]))
def test_as_many_rows_as_asked_for_increasing_and_of_the_drive(count: int, size: int | None, how: str) -> None:
    settings = LibrarySettings.read({"choose": how, "size": size}, "test")
    rows = choose(np.arange(count), settings)
    if size is None:
        assert min(count, LEAST_SIZE) <= len(rows) <= PAPER_SIZE
    else:
        assert len(rows) == min(count, size)
    assert np.all(np.diff(rows) > 0)
    assert rows[0] >= 0
    assert rows[-1] < count


@given(COUNTS, st.integers(1, 400))
def test_even_rows_leave_gaps_that_differ_by_one_at_most(count: int, size: int) -> None:
    rows = evenly(count, size)
    gaps = np.diff(rows)
    assert gaps.size == 0 or gaps.max() - gaps.min() <= 1
    # half a gap at either end, within a frame
    assert abs(rows[0] - (count - 1 - rows[-1])) <= 1


def test_no_rows_of_no_frames() -> None:
    assert evenly(0, 5).tolist() == []
    assert evenly(5, 0).tolist() == []


def test_a_random_choice_depends_on_its_seed_alone() -> None:
    stamps = np.arange(500)
    first, again, other = (choose(stamps, LibrarySettings(seed=seed)) for seed in (0, 0, 1))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_choice_by_coverage_needs_features() -> None:
    with pytest.raises(ValueError, match="features"):
        choose(np.arange(10), LibrarySettings(choose="coverage"))


def test_an_unknown_way_is_refused_with_the_choices() -> None:
    with pytest.raises(SettingsError, match="one of random, spread, coverage, not 'best'"):
        LibrarySettings.read({"choose": "best"}, "test")


def test_a_run_keeps_the_images_that_its_features_chose(drive: Demo, tmp_path: Path) -> None:
    """The images are read from the log a second time: each must be the one at its reference's stamp."""
    done = run(
        drive.log,
        tmp_path,
        load_pipeline("default", [*QUICK, "library.size=9", "propose.per_query=1"]),
        execution=Execution(2),
    )
    references = load_references(tmp_path / "library")
    stamps = np.array([reference.stamp_ns for reference in references])
    assert len(stamps) == 9
    assert np.isin(stamps, done.keyframes.stamp_ns).all()
    for reference, encoded in zip(references, logs.open(drive.log, None).frames(stamps), strict=True):
        assert encoded.stamp_ns == reference.stamp_ns
        assert np.array_equal(encoded.decode().image, reference.image)


def test_what_one_drive_explains_the_other_need_not(drive: Demo, tmp_path: Path) -> None:
    pipeline = load_pipeline("default", [*QUICK, "library.size=12"])
    build_library([drive.log, drive.log], tmp_path / "twice", pipeline, execution=Execution(2))
    stamps = [reference.stamp_ns for reference in load_references(tmp_path / "twice")]
    assert len(stamps) == 12
    assert len(set(stamps)) == 12, "two equal drives, and no view of them twice"


def test_a_library_without_keypoints_serves_other_drives(drive: Demo, tmp_path: Path) -> None:
    """Places described by patches alone, as `quick` has them."""
    pipeline = load_pipeline("quick", ["pictures.megapixels=0", "library.size=12"])
    build_library([drive.log], tmp_path / "library", pipeline)
    done = run(drive.log, tmp_path / "run", pipeline, tmp_path / "library", execution=Execution(2))
    assert done.record["library"]["coverage"]["frames"] == 0, "nothing tells"
    assert not any("The library explains" in text for text in done.record["warnings"])
