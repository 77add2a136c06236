"""The lens of a camera that nothing calibrates, by rendered streets, and by images that do not tell it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vplog.data import Camera, Frame
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.odometry.self_calibration import Lens, lens_of
from vplog.run import self_calibration
from vplog.testing import pictures
from vplog.verbs.demo.scene import make_scene, take_picture
from vplog.verbs.demo.settings import DemoSettings

WIDTH, HEIGHT = 400, 225
FOCAL_PX = 230.0


def test_a_bend_of_a_street_tells_the_focal_length() -> None:
    """From a focal length half as long again as from one with the distortion of a wide lens."""
    scene = make_scene(DemoSettings(seed=11, laps=0.6, frame_rate_hz=10.0, width=WIDTH, height=HEIGHT))
    camera = Lens(FOCAL_PX, 0.0).of(scene.camera)
    scene = replace(scene, camera=camera)
    bend = [Frame(int(scene.stamp_ns[row]), camera, take_picture(scene, row)[0]) for row in range(40, 75)]
    found = lens_of([lambda: bend, lambda: bend], replace(camera, matrix=None))
    assert found is not None
    assert found.focal_px == pytest.approx(FOCAL_PX, rel=0.03)
    assert found.radial == pytest.approx(0.0, abs=0.03)


def test_excerpts_of_a_long_drive_are_also_where_it_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two bends and four of the straight parts of a lap."""
    scene = make_scene(DemoSettings(seed=5, laps=0.6, frame_rate_hz=10.0, width=128, height=72, block_length_m=100.0))
    log = pictures.PictureLog([take_picture(scene, row)[0] for row in range(len(scene.stamp_ns))])
    monkeypatch.setattr(self_calibration, "EXCERPT", 20)
    found = [*self_calibration._turning(log, log.stamps(), 1, Execution())]
    assert len(found) > 2
    turned = [se3.angle(se3.between(*scene.world_from_body[[first, first + 20]])) for first in found]
    assert np.degrees(min(turned[:2])) > 60.0 > np.degrees(max(turned[2:]))
    for name, value in (("_MOST_APART", 1), ("_EXCERPTS", 2)):
        monkeypatch.setattr(self_calibration, name, value)
    excerpts = self_calibration._excerpts(log, Execution())
    starts = [one.args[1][0] - log.stamps()[0] for one in excerpts]  # type: ignore[attr-defined]
    assert starts[1:3] == found[:2]


def test_images_that_do_not_move_tell_none() -> None:
    camera = Camera("camera", None, "none", np.zeros(0), 160, 120, np.eye(4))
    still = [Frame(row * 10**8, camera, pictures.texture(4)) for row in range(12)]
    assert lens_of([lambda: still, lambda: still], camera) is None
    assert lens_of([], camera) is None
