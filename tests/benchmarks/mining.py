"""Mining a place (Algorithm 1, lines 2 to 9) against finding its features at all."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

import cv2
import faiss
import numpy as np

from tests.benchmarks.measure import Figure, in_turns, one_thread
from vplog.execution.execution import Execution
from vplog.places import matches

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.benchmarks.images import Images
    from vplog.data import Bytes, Features
    from vplog.features.extractors import FeatureSettings
    from vplog.pipeline import Pipeline
    from vplog.places.bobb import BobbState


def mining(images: Images, pipeline: Pipeline, name: str, bar: float, rounds: int) -> Figure:
    """describe, which is nearest neighbours and discovery, to bare SIFT of the same images; both on one thread."""
    with one_thread():
        state = pipeline.places.learn(images.references(pipeline.features), Execution())
        features = [pipeline.features(image) for image in images.images]
        sift = bare_sift(pipeline.features)
        turns = in_turns(
            lambda: [state.describe(one) for one in features], lambda: [sift(image) for image in images.images], rounds
        )
        mined, found = (1000 * part / len(features) for part in turns.medians)
        facts = {
            "images": len(features),
            "size": "x".join(str(side) for side in images.images[0].shape[::-1]),
            "mining_ms": round(mined, 2),
            "sift_ms": round(found, 2),
            "recall_of_first_neighbours": round(recall(state, features), 3),  # pyrefly: ignore[bad-argument-type]
        }
    return Figure(f"mining / SIFT, {name}, {images.name}, one thread", turns.ratio, bar, at_most=True, facts=facts)


def describing(images: Images, pipeline: Pipeline, name: str, bar: float, rounds: int, threads: int) -> Figure:
    """Frames per second from image to place to those of bare SIFT, all cores busy in both. Decoding is in neither."""
    state = pipeline.places.learn(images.references(pipeline.features), Execution(threads))
    sift = bare_sift(pipeline.features)

    def describe(image: Bytes) -> Any:
        return state.describe(pipeline.features(image))

    def all_of(work: Callable[[Bytes], Any]) -> None:
        list(Execution(threads).map(work, images.images, ahead=2))

    with one_thread():  # OpenCV's setting is the process's: the workers change it for all
        turns = in_turns(lambda: all_of(sift), lambda: all_of(describe), rounds, time.perf_counter)
    bare, whole = (len(images.images) / part for part in turns.medians)
    facts = {
        "images": len(images.images),
        "size": "x".join(str(side) for side in images.images[0].shape[::-1]),
        "threads": threads,
        "describe_fps": round(whole, 1),
        "sift_fps": round(bare, 1),
    }
    return Figure(
        f"describe fps / SIFT fps, {name}, {images.name}, all cores", turns.ratio, bar, at_most=False, facts=facts
    )


def bare_sift(settings: FeatureSettings) -> Callable[[Bytes], Any]:
    """OpenCV's SIFT alone, with the extractor's numbers and on images as small as it makes them."""
    assert settings.kind == "sift"

    def detect(image: Bytes) -> Any:
        share = min(math.sqrt(settings.max_megapixels * 1e6 / image.size), 1.0)
        size = max(round(image.shape[1] * share), 1), max(round(image.shape[0] * share), 1)
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if share < 1 else image
        sift = cv2.SIFT.create(
            nfeatures=settings.max_features,
            contrastThreshold=settings.contrast_threshold,
            enable_precise_upscale=True,
        )
        return sift.detectAndCompute(small, None)

    return detect


def recall(state: BobbState, features: list[Features]) -> float:
    """Share of features whose nearest library feature the graph finds, or another one just as near."""
    matcher, settings = state.matcher, state.settings
    right = count = 0
    for kind, described in zip(matcher.indexed(), (matches.keypoints_of, matches.patches_of), strict=True):
        if kind is None:
            continue
        exact = faiss.IndexFlatL2(kind.graph.d)
        exact.add(kind.graph.reconstruct_n(0, kind.graph.ntotal))
        for one in features:
            values, _ = described(one, settings)
            if len(values):
                found = kind.graph.search(values, settings.neighbours)[0][:, 0]
                nearest = exact.search(values, 1)[0][:, 0]
                right += int(np.sum(found <= nearest))
                count += len(values)
    return right / max(count, 1)
