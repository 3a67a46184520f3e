# SPDX-License-Identifier: Apache-2.0
"""``metadata.yaml`` of a bag of several files, as rosbag2 writes it (format version 9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml
from rosbags.rosbag2.metadata import dump_qos_v9

from tactile_resonance.analysis import write_whole
from tactile_resonance.recording.stored_file import sync_folder
from tactile_resonance.scan.point_file import BAG_VERSION, FileContent, TopicContent

# the compiled one, where there is one: a run of a thousand points has ten thousand lines
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def write_bag_metadata(folder: Path, files: Sequence[FileContent]) -> None:
    """Make all these files of a folder one bag.

    Parameters
    ----------
    folder : Path
    files : sequence of FileContent
        In any order; listed by the time of their first message. A topic must have one type, of one
        definition, in all of them.
    """
    content = {"rosbag2_bagfile_information": bag_metadata(files)}
    text = yaml.dump(content, Dumper=_DUMPER, sort_keys=False, allow_unicode=True)
    write_whole(folder / "metadata.yaml", text.encode())
    sync_folder(folder)


def bag_metadata(files: Sequence[FileContent]) -> dict[str, Any]:
    """The content of ``metadata.yaml`` below its only key."""
    files = sorted(files, key=lambda file: (file.start_ns, file.name))
    start_ns = min((file.start_ns for file in files), default=0)
    end_ns = max((file.end_ns for file in files), default=0)
    return {
        "version": BAG_VERSION,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": end_ns - start_ns},
        "starting_time": {"nanoseconds_since_epoch": start_ns},
        "message_count": sum(file.count for file in files),
        "topics_with_message_count": [_topic(topic) for topic in _topics(files)],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.name for file in files],
        "files": [
            {
                "path": file.name,
                "starting_time": {"nanoseconds_since_epoch": file.start_ns},
                "duration": {"nanoseconds": file.end_ns - file.start_ns},
                "message_count": file.count,
            }
            for file in files
        ],
        "custom_data": None,
        "ros_distro": "rosbags",
    }


def _topics(files: Sequence[FileContent]) -> list[TopicContent]:
    """Topics of all files together, by name."""
    merged: dict[str, TopicContent] = {}
    for file in files:
        for topic in file.topics:
            before = merged.get(topic.name)
            count = topic.count + (before.count if before else 0)
            merged[topic.name] = replace(topic, count=count)
    return [topic for _, topic in sorted(merged.items())]


def _topic(topic: TopicContent) -> dict[str, Any]:
    return {
        "topic_metadata": {
            "name": topic.name,
            "type": topic.type_name,
            "serialization_format": "cdr",
            "offered_qos_profiles": dump_qos_v9([] if topic.qos is None else [topic.qos]),
            "type_description_hash": topic.type_hash,
        },
        "message_count": topic.count,
    }
