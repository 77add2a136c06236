"""Joint graphs of many drives, in a small made-up city."""

from __future__ import annotations

import hashlib
import shutil
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.benchmarks.city import City, Cost, errors, undecided, with_join
from vplog.maps.joining import components
from vplog.maps.joining.joint_record import (
    count_between,
    joint_ledgers,
    keyframe_poses,
    read_joint,
    recorded_components,
    write_joint,
)
from vplog.maps.storage.map_store import Store
from vplog.pipeline import load_pipeline
from vplog.results import tables

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

COUNT = 16
PIPELINE = with_join(load_pipeline("default"), judged_anew=8, grown_share=0.4)


@pytest.fixture(autouse=True)
def plain() -> Iterator[None]:
    """What is decided of closures is another test's."""
    with undecided():
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> City:
    """A city whose joint graph is that of all but the last two drives."""
    city = City(tmp_path_factory.mktemp("city"), COUNT, seed=1)
    city.grow(COUNT)
    with undecided():
        Cost().solve(city, COUNT - 2, PIPELINE)
    return city


@pytest.fixture
def city(made: City, tmp_path: Path) -> City:
    return at(made, shutil.copytree(made.root, tmp_path / "map"))


def at(made: City, root: Path) -> City:
    """The city with its map in another folder."""
    copy = City(root, COUNT)
    for one in made.drives:
        ledgers = [replace(ledger, path=root / ledger.path.relative_to(made.root)) for ledger in one.ledgers]
        copy.drives.append(replace(one, ledgers=ledgers))
    return copy


def digests(root: Path) -> dict[str, str]:
    files = [root / "joint.json", *sorted(root.glob("joint/**/*.*"))]
    return {
        one.relative_to(root).as_posix(): hashlib.sha256(one.read_bytes()).hexdigest() for one in files if one.is_file()
    }


def component(root: Path) -> dict:
    return max(
        (one for group in read_joint(root)["groups"] for one in group["components"]), key=lambda one: len(one["drives"])
    )


def test_a_drive_more_touches_no_other(city: City) -> None:
    before = digests(city.root)
    poses = {
        drive: keyframe_poses(Store(city.root), recorded_components(Store(city.root)), drive)
        for drive in component(city.root)["drives"]
    }
    cost = Cost()
    cost.solve(city, COUNT - 1, PIPELINE)
    cost.solve(city, COUNT, PIPELINE)
    after, found = digests(city.root), component(city.root)
    assert {name: after.get(name) for name in before if name != "joint.json"} == {
        name: text for name, text in before.items() if name != "joint.json"
    }
    assert cost.solved == 0
    assert len(found["drives"]) == COUNT
    assert {f"d{COUNT - 2:06d}", f"d{COUNT - 1:06d}"} <= set(found["grown"])
    store = Store(city.root)
    joint = recorded_components(store)
    for drive, known in poses.items():
        np.testing.assert_array_equal(keyframe_poses(store, joint, drive), known)
    assert errors(city, COUNT, 2)[1] < 3.0
    ledgers = joint_ledgers(store, {one.folder.name for one in joint.values()})
    assert Counter(found["between"]) == count_between(ledgers)
    assert min(found["between"].values()) > 0


def test_one_batch_or_two_or_a_killed_one_end_with_the_same_bytes(
    city: City, made: City, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        pass

    def killed(*_: object) -> None:
        raise Killed

    other = at(made, shutil.copytree(city.root, tmp_path / "other"))
    Cost().solve(city, COUNT - 1, PIPELINE)
    Cost().solve(city, COUNT, PIPELINE)
    with monkeypatch.context() as patch:
        patch.setattr(components, "write_joint", killed)
        with pytest.raises(Killed):
            Cost().solve(other, COUNT, PIPELINE)
    Cost().solve(other, COUNT, PIPELINE)
    assert digests(other.root) == digests(city.root)
    Cost().solve(other, COUNT, PIPELINE)
    assert digests(other.root) == digests(city.root)


def test_the_whole_is_solved_when_it_is_asked_for_and_when_it_has_grown(city: City) -> None:
    Cost().solve(city, COUNT, PIPELINE)
    grown = errors(city, COUNT, 2)[0]
    cost = Cost()
    cost.solve(city, COUNT, PIPELINE, whole=True)
    found = component(city.root)
    assert (cost.solved, len(found["drives"]), "grown" in found) == (1, COUNT, False)
    assert [one.name for one in city.root.glob("joint/*")] == [found["folder"]]
    assert errors(city, COUNT, 2)[0] < 1.05 * grown
    ledgers = tables.read_joins(city.root / "joint" / found["folder"] / "joins.parquet")
    assert sum(np.nansum(one.weight) for one in ledgers.values()) > 0
    again = Cost()
    again.solve(city, COUNT, PIPELINE, whole=True)
    assert again.solved == 0


def test_the_whole_is_solved_when_more_than_a_share_has_grown(city: City) -> None:
    cost = Cost()
    cost.solve(city, COUNT, with_join(PIPELINE, grown_share=0.001))
    assert cost.solved == 2
    assert "grown" not in component(city.root)


def test_a_drive_that_is_gone_is_solved_without(city: City) -> None:
    Cost().solve(city, COUNT, PIPELINE)
    gone = component(city.root)["drives"][3]
    city.drives = [one for one in city.drives if one.name != gone]
    for one in city.drives:
        one.ledgers[:] = [ledger for ledger in one.ledgers if ledger.earlier != gone]
    Cost().solve(city, COUNT - 1, PIPELINE)
    record = read_joint(city.root)
    assert gone not in {drive for group in record["groups"] for one in group["components"] for drive in one["drives"]}
    assert len(component(city.root)["drives"]) >= COUNT - 3


def test_damaged_poses_are_made_again(city: City) -> None:
    """Of a drive that the new one meets; others are looked at when they are needed."""
    found = component(city.root)
    met = [one.earlier for one in city.drives[COUNT - 2].ledgers if one.earlier in found["drives"]]
    folder = found.get("grown", {}).get(met[0], found["folder"])
    path = city.root / "joint" / folder / f"drive={met[0]}" / "keyframes.parquet"
    path.write_bytes(path.read_bytes()[:100])
    Cost().solve(city, COUNT, PIPELINE)
    store = Store(city.root)
    joint = recorded_components(store)
    assert len(component(city.root)["drives"]) == COUNT
    assert len(keyframe_poses(store, joint, met[0])) == 200


def test_a_damaged_ledger_is_left_out_and_made_again_by_the_next_join(city: City) -> None:
    ledger = city.drives[COUNT - 1].ledgers[0]
    data = bytearray(ledger.path.read_bytes())
    data[len(data) // 2] ^= 4
    ledger.path.write_bytes(data)
    record = Cost().solve(city, COUNT, PIPELINE)
    [reason] = [group["reason"] for group in record["groups"] if "reason" in group]
    assert str(ledger.path) in reason
    assert "made again by the next join" in reason
    assert not ledger.path.exists()


def test_a_record_of_before_is_begun_anew(city: City) -> None:
    """One that does not say by what closures were decided."""
    record = read_joint(city.root)
    del record["judged"]
    write_joint(city.root, {name: value for name, value in record.items() if name != "format"})
    Cost().solve(city, COUNT, PIPELINE)
    assert len(component(city.root)["drives"]) == COUNT
