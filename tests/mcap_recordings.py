"""MCAP files for tests, as the writers of each encoding write them."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.writer import Writer
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.writer import Writer as Ros2Writer

MAPPING = """
name = "log"
task = "walk"
fps = 10
[columns."observation.state"]
fields = ["/pose:position.x", "/pose:joints"]
[columns.action]
fields = ["/command:turn"]
[split]
gap_s = 0.35
"""
ROS = """float64 turn
"""
ROS_POSE = """Point position
float64[2] joints
================================================================================
MSG: demo/Point
float64 x
float64 y
"""

Message = tuple[str, float, dict[str, Any]]


def pose(time: float, x: float) -> Message:
    return "/pose", time, {"position": {"x": x, "y": 0.0}, "joints": [x + 0.25, -x]}


def command(time: float, turn: float) -> Message:
    return "/command", time, {"turn": turn}


def ns(time: float) -> int:
    return round(time * 1e9)


def write_json(path: Path, messages: Iterable[Message]) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels: dict[str, int] = {}
        for topic, time, content in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "json", schema_id=0)
            writer.add_message(channels[topic], ns(time), json.dumps(content).encode(), ns(time))
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def write_ros2(path: Path, messages: Iterable[Message]) -> Path:
    with path.open("wb") as file:
        writer = Ros2Writer(file)
        schemas = {
            "/pose": writer.register_msgdef("demo/Pose", ROS_POSE),
            "/command": writer.register_msgdef("demo/Command", ROS),
        }
        for topic, time, content in messages:
            writer.write_message(topic, schemas[topic], content, ns(time))
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def write_protobuf(path: Path, messages: Iterable[Message]) -> Path:
    def message(name: str, *fields: tuple[str, int, str]) -> DescriptorProto:
        proto = DescriptorProto(name=name)
        for number, (field, label, kind) in enumerate(fields, start=1):
            is_double = kind == "double"
            proto.field.add(
                name=field,
                number=number,
                label=label,
                type=FieldDescriptorProto.TYPE_DOUBLE if is_double else FieldDescriptorProto.TYPE_MESSAGE,
                type_name=None if is_double else kind,
            )
        return proto

    one, many = FieldDescriptorProto.LABEL_OPTIONAL, FieldDescriptorProto.LABEL_REPEATED
    file_proto = FileDescriptorProto(name="demo.proto", package="demo", syntax="proto3")
    file_proto.message_type.extend(
        [
            message("Point", ("x", one, "double"), ("y", one, "double")),
            message("Pose", ("position", one, ".demo.Point"), ("joints", many, "double")),
            message("Command", ("turn", one, "double")),
        ]
    )
    pool = DescriptorPool()
    pool.AddSerializedFile(file_proto.SerializeToString())
    kinds = {
        topic: GetMessageClass(pool.FindMessageTypeByName(f"demo.{name}"))
        for topic, name in (("/pose", "Pose"), ("/command", "Command"))
    }
    with path.open("wb") as file:
        writer = ProtobufWriter(file)
        for topic, time, content in messages:
            writer.write_message(topic, kinds[topic](**content), ns(time), ns(time))
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def log() -> list[Message]:
    """Poses at 25 Hz from 0 s, commands at 4 Hz from 0.13 s, a hole from 2 s to 3 s."""
    times = [t for t in np.arange(0, 5, 0.04) if not 2 < t < 3]
    messages = [pose(float(t), float(t)) for t in times]
    messages += [command(float(t), 10 * float(t)) for t in np.arange(0.13, 4.9, 0.25)]
    return sorted(messages, key=lambda message: message[1])
