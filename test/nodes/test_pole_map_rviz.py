# SPDX-License-Identifier: Apache-2.0
"""The rviz view asks for what the node offers, in the colours of the legend."""

import pytest
import yaml

from tactile_resonance.configuration import share_path
from tactile_resonance.scan.pole_map import HIGH_RGB, LOW_RGB
from tactile_resonance.scan.scene import read_scan_scene


@pytest.fixture
def config():
    return yaml.safe_load(share_path("config/pole_map.rviz").read_text())


@pytest.fixture
def view(config):
    return config["Visualization Manager"]


def test_topics_and_their_quality_are_those_of_the_node(view):
    topics = {
        d["Topic"]["Value"]: (d["Class"].split("/")[1], d["Topic"])
        for d in view["Displays"]
        if "Topic" in d
    }
    # relative, so that they follow the namespace
    assert {topic: kind for topic, (kind, _) in topics.items()} == {
        "pole_map": "PointCloud2",
        "pole_map/markers": "MarkerArray",
        "pole_map/legend": "MarkerArray",
        "pole_map/surface": "MarkerArray",
    }
    for _, topic in topics.values():
        assert topic["Durability Policy"] == "Transient Local"
        assert topic["Reliability Policy"] == "Reliable"


def test_all_is_shown_and_only_what_is_needed_beside_it(config, view):
    assert all(d["Enabled"] is d["Value"] is True for d in view["Displays"])
    assert {p["Name"] for p in config["Panels"]} == {"Displays", "Views"}


def test_points_are_coloured_by_f0_as_the_legend_is_and_of_one_size_on_every_map(view):
    (cloud,) = [d for d in view["Displays"] if d["Class"].endswith("PointCloud2")]
    assert cloud["Channel Name"] == "f0_hz"
    assert cloud["Color Transformer"] == "Intensity"
    assert cloud["Use rainbow"] is False
    assert cloud["Autocompute Intensity Bounds"] is True
    assert cloud["Min Color"] == "; ".join(map(str, LOW_RGB))
    assert cloud["Max Color"] == "; ".join(map(str, HIGH_RGB))
    assert cloud["Style"] == "Points"  # the one whose size is in pixels


def test_the_fixed_frame_is_that_of_the_scene(view):
    scene = read_scan_scene(share_path("config/scenes/inclusion_scan.yaml"))
    assert view["Global Options"]["Fixed Frame"] == scene.frame_id
