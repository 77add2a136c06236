"""From the ellipsoid to a plane and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vplog.data import Gps
from vplog.geometry.geodesy import geodetic, local_enu, utm, utm_zone

ORIGINS = st.tuples(
    st.floats(-90.0, 90.0), st.floats(-180.0, 180.0), st.floats(-400.0, 9000.0)
)  # the lowest shore to the highest peak
OFFSETS = st.lists(
    st.tuples(st.floats(-2e4, 2e4), st.floats(-2e4, 2e4), st.floats(-500.0, 5000.0)), min_size=1, max_size=5
)


@given(ORIGINS, OFFSETS)
def test_the_way_back_is_the_way_in(
    origin: tuple[float, float, float], offsets: list[tuple[float, float, float]]
) -> None:
    """Points within 20 km come back to a micrometre, at poles and the date line too."""
    enu = np.array([(0.0, 0.0, 0.0), *offsets])
    where = geodetic(enu, origin)
    assert (np.abs(where[:, 0]) <= 90.0).all()
    assert (np.abs(where[:, 1]) <= 180.0).all()
    gps = Gps(np.arange(len(enu)), where[:, 0], where[:, 1], where[:, 2], np.full((len(enu), 3, 3), np.nan))
    back = local_enu(gps).enu_m
    # at a pole the first fix's own east is anywhere, so distances are compared there
    steps = np.linalg.norm(back[:, None] - back[None], axis=-1), np.linalg.norm(enu[:, None] - enu[None], axis=-1)
    np.testing.assert_allclose(steps[0], steps[1], atol=1e-5)
    if abs(origin[0]) < 89.9:
        np.testing.assert_allclose(back, enu, atol=1e-4)


def test_known_lengths_of_a_degree() -> None:
    """WGS84: 110 574.3 m of latitude at the equator and 111 319.5 m of longitude (NIMA TR8350.2's ellipsoid)."""
    north = geodetic(np.array([[0.0, 1.0, 0.0]]), (0.0, 0.0, 0.0))[0]
    east = geodetic(np.array([[1.0, 0.0, 0.0]]), (0.0, 0.0, 0.0))[0]
    np.testing.assert_allclose(1.0 / north[0], 110_574.3, rtol=1e-5)
    np.testing.assert_allclose(1.0 / east[1], 111_319.5, rtol=1e-5)


@pytest.mark.parametrize(
    ("longitude", "latitude", "zone", "east", "north"),
    [
        (11.5755, 48.1372, 32, 691603.7765982752, 5334757.803636242),
        (151.2153, -33.8568, 56, 334900.56965226424, 6252288.752888294),
        (5.3221, 60.3913, 32, 297353.93272915104, 6700648.345231735),
        (-70.6693, -33.4489, 19, 344846.72031010315, 6297700.155609685),
        (15.6, 78.22, 33, 513674.0649389056, 8682991.984972183),
    ],
)
def test_utm_is_that_of_proj(longitude: float, latitude: float, zone: int, east: float, north: float) -> None:
    """Values of PROJ 9 (pyproj 3.7.2), proj=utm ellps=WGS84; Bergen and Svalbard lie in widened zones."""
    assert utm_zone(longitude, latitude) == zone
    found = utm(np.array([latitude]), np.array([longitude]), zone)
    np.testing.assert_allclose(found, [[east, north]], rtol=0, atol=1e-7)
