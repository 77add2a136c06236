"""Settings of the demo drive, and a small variant for tests."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from vplog.settings import Settings


class DemoSettings(Settings):
    """A car that circles one city block, and the sensors it carries. The defaults give about 230 frames."""

    seed: int = Field(default=7, ge=0)
    """Seed of the street, the traffic and every sensor's noise: the same seed gives the same bytes."""
    laps: float = Field(default=1.5, gt=0.1, le=10)
    """Rounds driven; what goes beyond 1 passes the same places again, in other light and traffic."""
    block_length_m: float = Field(default=60.0, ge=20, le=120)
    """Length of the block between street axes, along x; the drive starts in the middle of this side."""
    block_width_m: float = Field(default=40.0, ge=16, le=120)
    """Width of the block between street axes, along y."""
    corner_radius_m: float = Field(default=7.0, ge=3, le=12)
    """Radius of the turns at the four corners; wider ones than 12 m would run through the houses inside."""
    speed_m_s: float = Field(default=6.0, gt=0.5, le=20)
    """Speed of the car along the axis of the street."""
    frame_rate_hz: float = Field(default=4.0, gt=0.1, le=60)
    """Camera frames per second."""
    width: int = Field(default=640, ge=64, le=4096)
    """Width of the images in px."""
    height: int = Field(default=360, ge=64, le=4096)
    """Height of the images in px."""
    depth: bool = False
    """Also write a depth image for every frame, in mm, registered to the grey image."""
    stereo_baseline_m: float = Field(default=0.0, ge=0, le=2)
    """Also write the images of a second camera so far to the right; 0 writes none."""
    rear_camera: bool = False
    """Also write the images of a second camera that looks back."""
    turn_back_m: float = Field(default=0.0, ge=0, le=1e6)
    """Metres after which the car turns on the spot and drives back the way it came; 0 never turns."""
    odometry_rate_hz: float = Field(default=20.0, gt=1, le=1000)
    """Odometry samples per second."""
    odometry_scale_error: float = Field(default=0.01, ge=-0.5, le=0.5)
    """Relative error of every odometry step's length: wheels that are larger than the software assumes."""
    odometry_yaw_bias_rad_s: float = Field(default=0.011, ge=-1, le=1)
    """Constant error of the yaw rate: an uncalibrated gyroscope."""
    odometry_step_noise_m: float = Field(default=0.004, ge=0, le=1)
    """Standard deviation of the white noise of every odometry step, each axis."""
    odometry_turn_noise_rad: float = Field(default=0.0006, ge=0, le=1)
    """Standard deviation of the white noise of every odometry step's rotation, each axis."""
    imu_rate_hz: float = Field(default=0.0, ge=0, le=1000)
    """Samples of an inertial measurement unit per second; 0 writes none."""
    gps_rate_hz: float = Field(default=1.0, ge=0, le=100)
    """Satellite fixes per second; 0 writes none."""
    gps_sigma_m: float = Field(default=1.5, gt=0, le=100)
    """Standard deviation of a fix, east and north; twice as much up."""

    @model_validator(mode="after")
    def _turns_fit_the_block(self) -> Self:
        if 2 * self.corner_radius_m >= min(self.block_length_m, self.block_width_m):
            raise ValueError("corner_radius_m must be less than half of block_length_m and block_width_m")
        return self

    def street(self) -> Self:
        """Without what the street does not depend on."""
        own = {"seed", "block_length_m", "block_width_m", "corner_radius_m"}
        return type(self)(**self.model_dump(include=own))


SMALL = DemoSettings(
    laps=1.4,
    block_length_m=26.0,
    block_width_m=20.0,
    corner_radius_m=6.0,
    frame_rate_hz=2.5,
    width=384,
    height=216,
    odometry_yaw_bias_rad_s=0.03,
)
"""About 45 frames, of which about 13 pass known places again: quick enough for unit tests."""
