"""Drives of a map against their truth."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import vplog
from vplog.batch.evaluate_map import _means
from vplog.errors import SettingsError, TruthError
from vplog.maps.storage import map_store
from vplog.verbs.evaluate_run import FIGURES, broken_limits
from vplog.verbs.limits import read_limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import Said

    from vplog.verbs.demo.record import Demo


def test_drives_are_evaluated_each_and_by_tag(
    halves: Path, drive: Demo, tmp_path: Path, verb: Callable[..., Said]
) -> None:
    root, manifest = Path(shutil.copytree(halves, tmp_path / "map")), tmp_path / "drives.csv"
    tags = {"before": {"light": "day"}, "after": {"light": "night", "vehicle": "v1"}}
    with map_store.writing(root) as store:
        for name, own in tags.items():
            map_store.annotate(store, name, {"tags": own, "truth": str(drive.truth)})
    found = verb("evaluate", root, "--json").json
    alone = {name: vplog.evaluate(root / f"runs/drive={name}", drive.truth) for name in tags}
    figures = {
        one["drive"]: (one["tags"], one["ate_m"], one["false_closures"], one["error"]) for one in found["drives"]
    }
    assert figures == {
        name: (tags[name], one["ate_after"]["rmse_m"], one["closures"]["accepted_false"], "")
        for name, one in alone.items()
    }
    groups, ates = found["groups"], [one["ate_after"]["rmse_m"] for one in alone.values()]
    assert groups["light=night"] == {**groups["vehicle=v1"], "ate_m": alone["after"]["ate_after"]["rmse_m"]}
    assert groups["all"]["ate_m"] == groups[f"vplog {vplog.__version__}"]["ate_m"] == pytest.approx(sum(ates) / 2)

    manifest.write_text(f"log,name,truth\nx.mcap,before,{drive.truth}\ny.mcap,,gps\n")
    limit = f"ate_m>{alone['before']['ate_after']['rmse_m'] / 2}"
    said = verb("evaluate", root, "--truth", manifest, "--fail-on", limit, "--fail-on", "false_closures>99")
    assert (said.code, said.err.count("before has ate_m")) == (1, 1)
    assert "after has" not in said.err
    assert f"{manifest} names no truth of it." in said.out
    positions = tmp_path / "positions.tum"
    lines = [line.split() for line in drive.truth.read_text().splitlines() if not line.startswith("#")]
    positions.write_text("".join(f"{' '.join(line[:4])} 0 0 0 1\n" for line in lines))
    said = verb("evaluate", root, "--truth", positions)
    assert [f"vplog: warning: {', '.join(sorted(alone))}: The truth has no orient" in said.err, said.code] == [True, 0]
    manifest.write_text("log,truth\nx.mcap,gps\n")
    assert "No drive of" in verb("evaluate", root, "--truth", manifest).error
    run = (root / "runs/drive=before", "--truth", drive.truth, "--fail-on")
    assert verb("evaluate", *run, "ate_m<0").code == 0
    assert "The run has ate_m" in verb("evaluate", *run, limit).err
    assert "Did you mean ate_m?" in verb("evaluate", *run, "ate_n<0").error
    assert "is no limit" in verb("evaluate", *run, "ate_m<5%").error


def test_a_moved_log_is_followed_and_a_damaged_drive_is_named(halves: Path, drive: Demo, tmp_path: Path) -> None:
    root, moved, manifest = Path(shutil.copytree(halves, tmp_path / "map")), tmp_path / "moved.mcap", tmp_path / "d.csv"
    with map_store.writing(root) as store:
        map_store.annotate(store, "after", {"log": str(moved)})
    manifest.write_text(f"log,name,truth\n{moved},x,gps\ny.mcap,after,{drive.truth}\n")
    with pytest.raises(TruthError, match=f"Of after: The log of the run {moved} no longer exists"):
        vplog.evaluate(root, manifest)
    (root / "runs/drive=before/keyframes.parquet").unlink()
    manifest.write_text(f"log,truth\n{moved},{drive.truth}\n")
    rows = vplog.evaluate(root, manifest)["drives"]
    assert [(one["drive"], bool(one["error"])) for one in rows] == [("before", True), ("after", False)]


def test_where_no_closure_was_judged_none_is_known_to_be_false() -> None:
    assert _means([dict.fromkeys(FIGURES, None)])["false_closures"] is None


def test_a_limit_of_what_a_truth_without_orientations_leaves_open_says_so() -> None:
    """A TUM file was given, of positions alone."""
    found = {"ate_after": {"rmse_m": 1.0}, "rpe_after": None, "drift_after": None, "closures": None}
    for name in ("rpe_m", "drift_m"):
        with pytest.raises(SettingsError, match=f"{name} is not known.* one with orientations"):
            broken_limits(found, read_limits([f"{name}>1"], FIGURES, "a run"))
