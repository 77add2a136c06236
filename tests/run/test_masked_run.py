"""A drive whose camera sees its own bonnet: it recognises nothing by that once it is masked."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from tests.joined import rewritten
from tests.logs.drives import store
from vplog.logs import TopicChoice
from vplog.results.run_record import read_run_json
from vplog.results.tables import read_keyframes
from vplog.run.feature_extraction import image_topics, stored_features
from vplog.verbs.demo import SMALL
from vplog.verbs.demo.record import IMAGE, TYPES

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from mcap.records import Message

    from tests.conftest import Said
    from vplog.verbs.demo.record import Demo

QUICK = (
    "--set", "pictures.closures=0", "--set", "pictures.megapixels=0", "--set", "features.max_features=600",
    "--set", "features.max_megapixels=0.06", "--set", "places.neighbours=8", "--set", "verify.calibration.pairs=0",
    "--set", "propose.per_query=3", "--threads", "2",
)  # fmt: skip
HORIZON = 0.6


@pytest.fixture(scope="module")
def bonnet(drive: Demo, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive with the same texture in the lower part of each image, and its mask."""
    folder = tmp_path_factory.mktemp("bonnet")
    size = (SMALL.height, SMALL.width)
    texture = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 256, size).astype(np.float32), (0, 0), 1.2)
    texture = ((texture - texture.min()) / np.ptp(texture) * 255).astype(np.uint8)
    used = np.arange(SMALL.height)[:, None] < HORIZON * SMALL.height + np.zeros(SMALL.width)
    cv2.imwrite(str(folder / "mask.png"), used * np.uint8(255))

    def seen(topic: str, message: Message) -> bytes:
        if topic != IMAGE:
            return message.data
        image: Any = store(2).deserialize_cdr(message.data, TYPES[IMAGE])
        pixels = np.asarray(cv2.imdecode(np.asarray(image.data), cv2.IMREAD_GRAYSCALE))
        pixels[~used] = texture[~used]
        image.data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].ravel()
        return bytes(store(2).serialize_cdr(image, TYPES[IMAGE]))

    rewritten(drive.log, folder / "drive.mcap", seen)
    return folder


def test_a_masked_bonnet_neither_hides_closures_nor_makes_them(
    bonnet: Path, finished: Path, verb: Callable[..., Said], tmp_path: Path
) -> None:
    out = tmp_path / "run"
    assert verb("run", bonnet / "drive.mcap", "-o", out, "--mask", bonnet / "mask.png", *QUICK).code == 0
    plain, bare = (read_run_json(folder / "run.json") for folder in (finished, out))
    assert bare["counts"]["verdicts"]["accepted"] > 0.7 * plain["counts"]["verdicts"]["accepted"]
    features = stored_features(out / ".cache")
    assert features is not None
    points = np.concatenate([features[row].points for row in range(len(features))])
    assert points[:, 1].max() < HORIZON * SMALL.height
    keyframes, _ = read_keyframes(out / "keyframes.parquet")
    assert len(keyframes.stamp_ns) == len(features)


def test_a_mask_counts_by_its_content_and_not_by_its_name(
    tiny: Demo, verb: Callable[..., Said], tmp_path: Path
) -> None:
    mask, out = tmp_path / "mask.png", tmp_path / "run"
    used = np.full((tiny.camera.height, tiny.camera.width), 255, np.uint8)
    used[: len(used) // 3] = 0
    cv2.imwrite(str(mask), used)
    arguments = ("run", tiny.log, "-o", out, *QUICK, "--set", "library.size=4", "--json")
    assert verb(*arguments, "--mask", mask).json["stages"]["extract"]["result"] == "computed"
    moved = mask.rename(tmp_path / "other.png")
    assert "no topic /camera" in verb(*arguments, "--mask", f"/camera={moved}").error
    assert verb(*arguments, "--mask", moved).json["stages"]["extract"]["result"] == "reused"
    cv2.imwrite(str(moved), used[::-1])
    assert verb(*arguments, "--mask", moved).json["stages"]["extract"]["result"] == "computed"


def test_resume_takes_no_mask(verb: Callable[..., Said], tmp_path: Path) -> None:
    found = verb("run", "--resume", "-o", tmp_path, "--mask", "mask.png")
    assert found.code == 2
    assert "leave out --mask" in found.err


def test_features_depend_on_the_topic_of_their_mask() -> None:
    plain, masked = TopicChoice(), TopicChoice(mask_topics={IMAGE: "/front/masks"})
    assert image_topics(plain, IMAGE) != image_topics(masked, IMAGE)
    assert image_topics(plain, "/rear") == image_topics(masked, "/rear")
