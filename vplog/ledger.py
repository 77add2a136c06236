"""The ledger of a drive's candidates, checked in parts, so that a kill costs at most the last."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Closures
from vplog.loops.verify import calibration_share, drive_of, verify_between
from vplog.stage_codecs import closures_codec, json_codec

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vplog.data import Camera, Ints, Keyframes
    from vplog.features.store import FeaturesOf
    from vplog.loops.propose import Proposals
    from vplog.loops.verify import VerifySettings
    from vplog.stage_cache import StageCache

_CODE = ("vplog.loops.verify",)
_PART_CANDIDATES = 1000
"""Candidates of a part: 5 to 10 s of one core, as a part of the keyframes."""


def verify_in_parts(
    proposals: Proposals,
    keyframes: Keyframes,
    camera: Camera,
    features: FeaturesOf,
    settings: VerifySettings,
    cache: StageCache,
    threads: int,
    progress: Callable[[int, int], None],
) -> Closures:
    """The ledger of `loops.verify.verify_between`, whose row depends on its two frames and the calibration alone.

    A part has all candidates of some map frames, whose landmarks are made once all the same.
    """
    drive = drive_of(keyframes, camera, features.__getitem__, settings, camera.baseline_m)
    of = ["extract", "keyframes", "camera"]
    if not len(proposals.query):
        return verify_between(proposals, drive, drive)
    share = 0.0
    if camera.matrix is not None:
        exact = json_codec(float, float)
        share = cache.result("calibrate", of, [settings], _CODE, exact, lambda: calibration_share(drive, threads))
    found, reused, done, places = [], 0, 0, _parts(proposals.match)
    for number, rows in enumerate(places):
        part = proposals.rows(rows)
        cache.saw(candidates=[part.query, part.match, part.rank, part.score, part.support], share=share)
        name = f"verify-{number:06d}"
        found.append(
            cache.result(
                name, [*of, "candidates", "share"], [settings], _CODE, closures_codec(),
                lambda part=part, done=done: verify_between(
                    part, drive, drive, threads, lambda count, _: progress(done + count, len(proposals.query)), share
                ),
            )
        )  # fmt: skip
        reused += cache.told.pop(name)["result"] == "reused"
        done += len(rows)
    cache.tell("verify", len(places), reused)
    return merged(found, places)


def _parts(match: np.ndarray) -> list[Ints]:
    """Rows of the candidates of each part, by map frame."""
    order = np.argsort(match, kind="stable")
    begins = np.flatnonzero(np.diff(match[order], prepend=-1))
    # a map frame goes to the part in which its first candidate falls
    number = np.repeat(begins // _PART_CANDIDATES, np.diff(begins, append=len(order)))
    return [np.sort(order[number == part]) for part in np.unique(number)]


def merged(parts: Sequence[Closures], rows: Sequence[Ints]) -> Closures:
    """One ledger of several parts, by the numbers `rows` of their candidates."""
    place = np.argsort(np.concatenate(rows), kind="stable")
    columns = {}
    for field in fields(Closures):
        values = [getattr(part, field.name) for part in parts]
        if isinstance(values[0], np.ndarray):
            columns[field.name] = np.concatenate(values)[place]
        else:
            joined = [value for part in values for value in part]
            columns[field.name] = [joined[at] for at in place.tolist()]
    return Closures(**columns)
