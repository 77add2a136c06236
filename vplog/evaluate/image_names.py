"""Truth in the names of image files: a number, a position on earth, the place whose folder they are in."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import PurePosixPath

import numpy as np

from vplog.data import Floats, Ints
from vplog.errors import TruthError
from vplog.evaluate.pairs import position_pairs
from vplog.geometry.utm_name import FORM, utm_name

_NUMBER = re.compile(r"\d+")
_MOST_DEG = 1e4
"""Degrees; a heading beyond is something else."""
_DIGITS = 9
"""Longest number that counts images; longer ones are times."""


def numbers_of(query: Sequence[str], match: Sequence[str], tolerance: int = 0) -> tuple[Ints, Ints, bool] | None:
    """(Q,) and (M,) numbers in the names of two sets that no other name of the set has, and whether folders are part of
    them, as where each counts its own images.

    None where one has no such number, or its names are times, or the sets share no folder by which they could meet.
    Raises TruthError where several numbers may be meant, and pair the images differently.
    """
    of_query, of_match = ({str(PurePosixPath(name).parent) for name in names} for names in (query, match))
    number = {folder: at for at, folder in enumerate(sorted(of_query | of_match))}
    for by_folder in (False, True) if of_query & of_match else (False,):
        here, there = (_own_numbers(names, number if by_folder else {}) for names in (query, match))
        if here and there:
            alike = len({_NUMBER.sub("0", PurePosixPath(name).stem) for name in (*query, *match)}) == 1
            return *_meant(here, there, alike, tolerance, f"{query[-1]} and {match[-1]}"), by_folder
    return None


def _meant(
    here: Mapping[int, Ints], there: Mapping[int, Ints], alike: bool, tolerance: int, names: str
) -> tuple[Ints, Ints]:
    """The numbers, of those by their place from the end, that pair two sets: those that pair most of the smaller one,
    where others pair it differently and not half as many. In names that are alike they are at one place. Raises
    TruthError where that is not clear."""
    places = [(a, b) for a in here for b in there]
    if len(places) > 1:
        pairs = {(a, b): position_pairs(here[a][:, None], there[b][:, None], tolerance) for a, b in places}
        if alike and any(pairs[a, b].count for a, b in places if a == b):
            pairs = {(a, b): one for (a, b), one in pairs.items() if a == b}
        places.sort(key=lambda at: pairs[at].count if at in pairs else -1, reverse=True)
        best, least = pairs[places[0]], max(2.0, min(len(here[places[0][0]]), len(there[places[0][1]])) / 2)
        others = [one.count for one in pairs.values() if one != best]
        if others and (best.positive.sum() < least or best.count <= 2 * max(others)):
            raise TruthError(
                f"--truth index: names such as {names} have several numbers, and it is not clear which of them count "
                "the places. Give the pairs in a table with the header `query,match`: --truth FILE.csv."
            )
    return here[places[0][0]], there[places[0][1]]


def _own_numbers(names: Sequence[str], folders: Mapping[str, int]) -> dict[int, Ints]:
    """The numbers in names that no two share, by their place from the end; those of each of the numbered folders are
    far from those of the others."""
    paths = [PurePosixPath(name) for name in names]
    if any(re.fullmatch(r"\d+\.\d+", path.stem) for path in paths):
        return {}
    found, own = [_NUMBER.findall(path.stem) for path in paths], dict[int, Ints]()
    first = [2 * 10**_DIGITS * folders.get(str(path.parent), 0) for path in paths]
    for at in range(1, 1 + min(map(len, found), default=0)):
        column = [numbers[-at] for numbers in found]
        if max(map(len, column)) <= _DIGITS and len(set(zip(first, map(int, column), strict=True))) == len(column):
            own[at] = np.array(first, np.int64) + np.array(column, np.int64)
    return own


def folders_of(names: Sequence[str], drive: str) -> list[str]:
    """The folder of each image below that of the set. Raises TruthError where one is in none."""
    folders = [str(PurePosixPath(name).parent) for name in names]
    if "." in folders:
        raise TruthError(
            f"{drive}: {names[folders.index('.')]} is in no folder of its own, and --truth labels takes the folders "
            "of images for their places. Give the places in a table with the header `image,label`."
        )
    return folders


def utm_of(names: Sequence[str]) -> tuple[Floats, Floats]:
    """(N, 3) m east, north and a number far apart for each zone, and (N,) headings in degrees, NaN where unknown.

    Raises TruthError for the first name that gives no position.
    """
    positions, headings = np.zeros((len(names), 3)), np.full(len(names), np.nan)
    for row, name in enumerate(names):
        found = utm_name(name)
        if found is None:
            raise TruthError(f"{name} gives no position, as --truth utm needs. Names are {FORM}")
        south = found.letter.upper() < "N" if found.letter.isalpha() else False
        zone = int(found.zone[:2]) + 100 * south if found.zone.isascii() and found.zone.isdigit() else 0
        positions[row] = found.east, found.north, 1e9 * zone
        if abs(found.heading_deg) < _MOST_DEG:
            headings[row] = found.heading_deg
    return positions, headings


def row_finder(names: Sequence[str] | None, drive: str) -> Callable[[str], int | None]:
    """The row of an image by its path below the set, with the set's own name before it or not, or by its name or stem
    where no other image has it; None for what is no image of the set."""
    rows: dict[str, int] = {}
    for kind in (str, lambda name: PurePosixPath(name).name, lambda name: PurePosixPath(name).stem):
        found: dict[str, int] = {}
        for row, name in enumerate(names or ()):
            found[kind(name)] = row if kind(name) not in found else -1
        rows = {**{name: row for name, row in found.items() if row >= 0}, **rows}

    def find(field: str) -> int | None:
        plain = field.replace("\\", "/").removeprefix("./")
        return rows.get(plain, rows.get(plain.removeprefix(f"{drive}/")))

    return find
