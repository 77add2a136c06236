"""hloc's recipe with pycolmap, for a process of its own: `python hloc_recipe.py FOLDER` prints JSON.

Sarlin et al., From Coarse to Fine, CVPR 2019, github.com/cvg/Hierarchical-Localization: SIFT, retrieval by VLAD,
mutual nearest neighbours that pass Lowe's ratio test, COLMAP's triangulation from known poses, its PnP. FOLDER has
`map/*.png`, `query/*.png` and `scene.json` with the pinhole camera, world_from_camera of the map's images, and how many
neighbours each has. pycolmap and PyAV are never loaded together.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.cluster.vq import kmeans2

RATIO = 0.8
"""hloc's `NN-ratio`."""
TOP = 10
"""Images that a query is matched with."""
WORDS = 64
"""Of VLAD (Jegou et al., CVPR 2010)."""
Array = Any


class Features:
    """Of one image, as hloc stores them: descriptors as half floats."""

    def __init__(self, extractor: pycolmap.Sift, path: Path) -> None:
        bitmap = pycolmap.Bitmap.read(str(path), as_rgb=False)
        assert bitmap is not None, path
        image = np.ascontiguousarray(bitmap.to_array())
        self.began = time.process_time()
        keypoints, descriptors = extractor.extract(image)
        self.points = keypoints[:, :2].astype(np.float64)
        norm = np.linalg.norm(descriptors, axis=1, keepdims=True)
        self.descriptors = (descriptors / np.maximum(norm, 1e-9)).astype(np.float16).astype(np.float32)

    @property
    def size(self) -> int:
        """Bytes: x, y, score and descriptor."""
        return len(self.points) * (2 * 4 + 2 + 2 * 128)


def vlad(descriptors: Array, words: Array) -> Array:
    """(WORDS * 128,) normalised within words, then as a whole."""
    word = (descriptors @ words.T * 2 - (words**2).sum(1)).argmax(1)
    total = np.zeros_like(words)
    np.add.at(total, word, descriptors - words[word])
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)
    return (total / np.maximum(np.linalg.norm(total), 1e-9)).ravel()


def match(a: Array, b: Array) -> Array:
    """(K, 2) mutual nearest neighbours of unit descriptors that pass the ratio test."""
    similar = a @ b.T
    every, best = np.arange(len(a)), similar.argmax(1)
    mutual = similar.argmax(0)[best] == every
    near = 2.0 * (1.0 - similar[every, best])
    similar[every, best] = -1.0
    next_one = 2.0 * (1.0 - similar.max(1))
    rows = np.flatnonzero(mutual & (near <= RATIO**2 * next_one))
    return np.column_stack([rows, best[rows]]).astype(np.uint32)


def neighbours(poses: Array, count: int) -> set[tuple[int, int]]:
    """Pairs of the map: of each image the nearest that look the same way, as hloc's pairs from poses."""
    pairs = set()
    for row, pose in enumerate(poses):
        turned = np.degrees(np.arccos(np.clip((np.einsum("nij,ij->n", poses[:, :3, :3], pose[:3, :3]) - 1) / 2, -1, 1)))
        distance = np.where(turned < 45, np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1), np.inf)
        distance[row] = np.inf
        nearest = np.argsort(distance)[:count]
        pairs |= {(min(row, other), max(row, other)) for other in nearest.tolist() if distance[other] < np.inf}
    return pairs


def quaternion(rotation: Array) -> list[float]:
    """w x y z."""
    x, y, z, w = pycolmap.Rotation3d(rotation).quat
    return [w, x, y, z]


def triangulated(folder: Path, scene: Any, names: list[str], found: list[Features]) -> Any:
    """The map's points, by COLMAP from known poses."""
    work, poses = folder / "colmap", np.array(scene["world_from_camera"])
    (work / "known").mkdir(parents=True)
    (work / "model").mkdir()
    camera, path = scene["camera"], work / "database.db"
    parameters = ",".join(map(str, camera["parameters"]))
    reader = pycolmap.ImageReaderOptions(camera_model="PINHOLE", camera_params=parameters)
    pycolmap.Database.open(path).close()
    pycolmap.import_images(path, folder / "map", pycolmap.CameraMode.SINGLE, names, reader)
    database = pycolmap.Database.open(path)
    numbers = {image.name: image.image_id for image in database.read_all_images()}
    number = database.read_all_cameras()[0].camera_id
    pairs = sorted(neighbours(poses, scene["neighbours"]))
    for name, features in zip(names, found, strict=True):
        database.write_keypoints(numbers[name], features.points.astype(np.float32))
    for a, b in pairs:
        matches = match(found[a].descriptors, found[b].descriptors)
        database.write_matches(numbers[names[a]], numbers[names[b]], matches)
    database.close()
    (work / "pairs.txt").write_text("".join(f"{names[a]} {names[b]}\n" for a, b in pairs))
    pycolmap.verify_matches(path, work / "pairs.txt")
    values = " ".join(map(str, camera["parameters"]))
    known = f"{number} PINHOLE {camera['width']} {camera['height']} {values}\n"
    (work / "known" / "cameras.txt").write_text(known)
    lines = []
    for name, pose in zip(names, poses, strict=True):
        own = np.linalg.inv(pose)
        numbers_of = " ".join(map(str, [*quaternion(own[:3, :3]), *own[:3, 3]]))
        lines.append(f"{numbers[name]} {numbers_of} {number} {name}\n\n")
    (work / "known" / "images.txt").write_text("".join(lines))
    (work / "known" / "points3D.txt").write_text("")
    start = pycolmap.Reconstruction(work / "known")
    return pycolmap.triangulate_points(start, path, folder / "map", work / "model"), numbers


def main(folder: Path) -> dict[str, Any]:
    scene = json.loads((folder / "scene.json").read_text())
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = False
    extraction.num_threads = 1
    extractor = pycolmap.Sift(extraction, pycolmap.Device.cpu)
    names = sorted(path.name for path in (folder / "map").iterdir())
    found = [Features(extractor, folder / "map" / name) for name in names]
    some = np.concatenate([one.descriptors[::10] for one in found])
    words = kmeans2(some, WORDS, iter=10, minit="points", rng=0)[0]
    places = np.array([vlad(one.descriptors, words) for one in found])
    began = time.perf_counter()
    model, numbers = triangulated(folder, scene, names, found)
    map_s = time.perf_counter() - began
    points = [
        _points(model, model.images[numbers[name]], len(one.points)) for name, one in zip(names, found, strict=True)
    ]
    camera = pycolmap.Camera(
        model="PINHOLE", width=scene["camera"]["width"], height=scene["camera"]["height"],
        params=scene["camera"]["parameters"],
    )  # fmt: skip
    answers = [
        answer(Features(extractor, path), path.name, words, places, found, points, camera)
        for path in sorted((folder / "query").iterdir())
    ]
    model_bytes = sum(file.stat().st_size for file in (folder / "colmap" / "model").iterdir())
    stored = sum(one.size for one in found) + places.size * 2 + model_bytes
    return {"answers": answers, "bytes": stored / len(names), "map_s": map_s, "points": model.num_points3D()}


def _points(model: Any, image: Any, count: int) -> Array:
    """(M, 3) of an image's features, NaN where not triangulated."""
    result = np.full((count, 3), np.nan)
    for row, point in enumerate(image.points2D):
        if point.has_point3D():
            result[row] = model.points3D[point.point3D_id].xyz
    return result


def answer(
    own: Features, name: str, words: Array, places: Array, found: list[Features], points: list[Array], camera: Any
) -> dict[str, Any]:
    """Pose and seconds of a query: matched with its likeliest images, solved by all their points."""
    likely = np.argsort(-(places @ vlad(own.descriptors, words)))[:TOP]
    px, xyz = [], []
    for row in likely.tolist():
        pairs = match(own.descriptors, found[row].descriptors)
        known = np.isfinite(points[row][pairs[:, 1], 0])
        px.append(own.points[pairs[known, 0]])
        xyz.append(points[row][pairs[known, 1]])
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = 12.0  # hloc's
    solved = pycolmap.estimate_and_refine_absolute_pose(np.concatenate(px), np.concatenate(xyz), camera, options)
    seconds = time.process_time() - own.began
    if solved is None:
        return {"name": name, "seconds": seconds, "inliers": 0, "world_from_camera": None}
    pose = np.vstack([solved["cam_from_world"].inverse().matrix(), [0, 0, 0, 1]])
    return {
        "name": name, "seconds": seconds, "inliers": int(solved["num_inliers"]), "world_from_camera": pose.tolist()
    }  # fmt: skip


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]))))
