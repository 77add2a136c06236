"""What viewers take for granted of Foxglove messages and do not say when it is not so: a panel just stays empty."""

from __future__ import annotations

import importlib
import math
from collections import defaultdict
from typing import TYPE_CHECKING, Any

import pytest
from google.protobuf.descriptor import FieldDescriptor

from tests.results.test_mcap import decode
from tests.results.test_shown import write

if TYPE_CHECKING:
    from collections.abc import Iterator

    Messages = list[tuple[str, int, Any]]


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory) -> Messages:
    found = decode(write(tmp_path_factory.mktemp("viewer") / "result.mcap"))
    assert len({topic for topic, _, _ in found}) > 10
    return found


def parts(message: Any) -> Iterator[Any]:
    """A message and all messages in it."""
    yield message
    for field, value in message.ListFields():
        if field.type == FieldDescriptor.TYPE_MESSAGE:
            for one in value if field.is_repeated else [value]:
                yield from parts(one)


def foxglove(messages: Messages) -> Iterator[tuple[str, int, Any]]:
    for topic, log_ns, message in messages:
        if message.DESCRIPTOR.full_name.startswith("foxglove."):
            yield topic, log_ns, message


def ns(stamp: Any) -> int:
    return stamp.seconds * 10**9 + stamp.nanos


def test_fields_are_those_of_the_published_schemas(messages: Messages) -> None:
    checked = set[str]()
    for _, _, message in foxglove(messages):
        for part in parts(message):
            kind = part.DESCRIPTOR
            if kind.full_name in checked or not kind.full_name.startswith("foxglove."):
                continue
            checked.add(kind.full_name)
            known = getattr(importlib.import_module(f"foxglove_schemas_protobuf.{kind.name}_pb2"), kind.name).DESCRIPTOR
            assert {(f.name, f.number, f.type, f.is_repeated) for f in kind.fields} == {
                (f.name, f.number, f.type, f.is_repeated) for f in known.fields
            }
    assert {"foxglove.ImageAnnotations", "foxglove.SceneUpdate", "foxglove.FrameTransforms"} & checked
    assert len(checked) >= 12


def test_numbers_are_finite_enums_known_colours_in_range_and_quaternions_of_length_one(messages: Messages) -> None:
    for topic, _, message in foxglove(messages):
        for part in parts(message):
            for field, value in part.ListFields():
                values = value if field.is_repeated else [value]
                if field.type == FieldDescriptor.TYPE_ENUM:
                    assert set(values) <= set(field.enum_type.values_by_number), (topic, field.full_name)
                elif field.type in (FieldDescriptor.TYPE_DOUBLE, FieldDescriptor.TYPE_FLOAT):
                    assert all(map(math.isfinite, values)), (topic, field.full_name)
            if part.DESCRIPTOR.name == "Color":
                assert all(0 <= value <= 1 for value in (part.r, part.g, part.b, part.a)), topic
            if part.DESCRIPTOR.name == "Quaternion":
                assert math.hypot(part.x, part.y, part.z, part.w) == pytest.approx(1, abs=1e-9), topic


def test_frames_hang_together_in_one_tree(messages: Messages) -> None:
    parent, used = dict[str, str](), set[str]()
    for _, _, message in foxglove(messages):
        for part in parts(message):
            kind = part.DESCRIPTOR.name
            if kind == "FrameTransform":
                assert parent.setdefault(part.child_frame_id, part.parent_frame_id) == part.parent_frame_id
            elif kind == "LocationFix":  # on earth
                continue
            elif "frame_id" in part.DESCRIPTOR.fields_by_name:
                used.add(part.frame_id)
    frames = set(parent) | set(parent.values())
    assert used - {""} <= frames
    calibrated = {m.frame_id for _, _, m in foxglove(messages) if m.DESCRIPTOR.name == "CameraCalibration"}
    images = {m.frame_id for _, _, m in foxglove(messages) if m.DESCRIPTOR.name == "CompressedImage"}
    assert images == calibrated == {"camera", "reference", "closure"}
    # rerun's 3D view is faulty at any moment at which an image has no frame
    began = {topic: log_ns for topic, log_ns, m in reversed(messages) if m.DESCRIPTOR.name == "CompressedImage"}
    assert set(began.values()) == {min(log_ns for _, log_ns, _ in messages)}
    roots = frames - set(parent)
    assert len(roots) == 1
    for frame in frames:
        seen = {frame}
        while frame in parent:
            frame = parent[frame]  # noqa: PLW2901 (up the tree)
            assert frame not in seen, "a loop"
            seen.add(frame)


def test_stamps_never_go_back_and_boxes_have_the_exact_stamp_of_their_image(messages: Messages) -> None:
    logged, stamps = defaultdict[str, list[int]](list), defaultdict[str, list[int]](list)
    for topic, log_ns, message in foxglove(messages):
        logged[topic].append(log_ns)
        if "timestamp" in message.DESCRIPTOR.fields_by_name:
            stamps[topic].append(ns(message.timestamp))
        if message.DESCRIPTOR.name == "ImageAnnotations":
            inner = {ns(one.timestamp) for kind in (message.points, message.texts, message.circles) for one in kind}
            assert inner <= {log_ns}, topic
    for found in (logged, stamps):
        for topic, values in found.items():
            assert values == sorted(values), topic
    boxes = next(topic for topic in logged if topic.endswith("/annotations"))
    image = next(topic for topic in logged if topic.startswith(boxes.removesuffix("annotations")) and "image" in topic)
    assert set(logged[boxes]) <= set(stamps[image])
    assert stamps[image] == logged[image]


def test_entities_of_a_scene_have_names_of_their_own(messages: Messages) -> None:
    for topic, _, message in foxglove(messages):
        if message.DESCRIPTOR.name == "SceneUpdate":
            names = [entity.id for entity in message.entities]
            assert len(set(names)) == len(names), topic
            for entity in message.entities:
                assert entity.frame_id
                for line in entity.lines:
                    assert len(line.colors) in (0, len(line.points)), topic
                    assert all(index < len(line.points) for index in line.indices), topic
