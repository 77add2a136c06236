"""From the ellipsoid to a plane and back."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vplog.data import Gps
from vplog.geometry.geodesy import geodetic, local_enu

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
