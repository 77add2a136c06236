"""Every benchmark runs, on next to nothing and without a look at the clock; and what they compare is the same thing."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.benchmarks import __main__ as benchmarks
from tests.benchmarks import images as pictures_of
from tests.benchmarks.discovery import discovery
from tests.benchmarks.images import Images
from tests.benchmarks.measure import Figure, Turns
from tests.benchmarks.mining import describing, mining
from tests.benchmarks.scale import scale
from tests.benchmarks.search import BEST, growth, is_exact, make_index, make_places, make_queries, search
from tests.places.pictures import texture
from vplog.features.sift import SiftSettings
from vplog.pipeline import Pipeline
from vplog.places.bobb import BobbSettings
from vplog.places.bobb_paper import PaperBobbSettings

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.verbs.demo.record import Demo

TINY = Pipeline(features=SiftSettings(max_features=150), places=BobbSettings(references=4, features=100))


@pytest.fixture(scope="module")
def images() -> Images:
    return Images("made up", [texture(n) for n in (1, 3)], [texture(n) for n in (0, 2, 4, 20, 21)])


def test_mining_and_describing(images: Images) -> None:
    for figure in (
        mining(images, TINY, "tiny", 0.4, rounds=1),
        describing(images, TINY, "tiny", 0.7, rounds=1, threads=2),
    ):
        assert figure.ratio > 0
    assert 0.5 < mining(images, TINY, "tiny", 0.4, rounds=1).facts["recall_of_first_neighbours"] <= 1


def test_the_fast_discovery_finds_the_literal_ones_boxes(images: Images) -> None:
    paper = PaperBobbSettings(partitions=3, columns=6, rows=4, features=100, references=2, grid=16)
    closed, partitions = discovery(images, TINY.features, BobbSettings(features=100), paper, 1000.0)
    assert closed.ratio > 0
    assert partitions.facts["votes_to_literal"] == pytest.approx(1.0, abs=1e-6)


def test_search_and_growth() -> None:
    figures = search(3000, BobbSettings(), queries=4, rounds=1, bars=(4.0, 40.0))
    assert len(figures) == 4
    assert all(figure.facts["exact"] for figure in figures)
    assert [figure.facts["places"] for figure in growth((500, 1000), BobbSettings(), queries=2)] == [500, 1000]


def test_scale(tmp_path: Path) -> None:
    """On a map of two drives, made once."""
    for graphs in (False, True):
        figures = list(scale(3000, tmp_path, queries=4, threads=2, codes=graphs, vectors=graphs))
        assert len(figures) == 3 + 2 * graphs
        assert figures[0].facts["drives"] == 2
        assert figures[1].facts["exact"] is True


@pytest.mark.parametrize("pairing", ["both", "best", "same"])
def test_a_search_over_the_made_up_map_is_exact(pairing: str) -> None:
    settings = BobbSettings()
    places = make_places(30_000, settings, seed=0)
    index = make_index(places, settings, pairing)
    for query in make_queries(places, 4, settings):
        assert is_exact(index, places, query, settings, pairing)


def test_the_made_up_map_is_as_skewed_as_it_says() -> None:
    places = make_places(60_000, BobbSettings(), seed=0)
    counts = np.sort(np.bincount(places.references.ravel(), minlength=1000))[::-1]
    assert 8.5 < counts[:10].mean() / np.median(counts) < 10.5
    assert all(len(set(row)) == len(row) for row in places.references[:100].tolist())
    queries = make_queries(places, 8, BobbSettings())
    index = make_index(places, BobbSettings(), "both")
    again = [index.query(query, BEST).score[0] for query in queries]
    assert np.mean(again[1::2]) > np.mean(again[::2])  # places seen again are nearer than any place is to a new one


def test_a_figure_is_held_to_its_bar() -> None:
    assert Figure("share", 0.4, 0.4, at_most=True).passed
    assert not Figure("share", 0.41, 0.4, at_most=True).passed
    assert Figure("times", 4.0, 4.0, at_most=False).passed
    assert not Figure("times", 3.9, 4.0, at_most=False).passed
    assert Figure("only told", 9.0, None, at_most=True).passed
    assert Turns([2.0, 9.0, 4.0], [1.0, 1.0, 2.0]).ratio == 2.0


def test_the_command_tells_in_json_and_by_its_status(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["benchmarks", "search", "--json", "--places", "2000", "--rounds", "1"])
    monkeypatch.setattr(benchmarks, "SEARCH_BARS", (1e9, 1e9))
    assert benchmarks.main() == 1
    told = json.loads(capsys.readouterr().out)
    assert len(told["figures"]) == 4
    assert not any(figure["passed"] for figure in told["figures"])


def test_without_real_drives_the_demo_is_measured(drive: Demo, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("VPLOG_DATA", str(tmp_path))
    monkeypatch.setattr(pictures_of, "make_drive", lambda _: drive)
    (found,) = pictures_of.drives(3)
    assert "demo" in found.name
    assert len(found.images) == 3
    assert len(found.library) > 10
