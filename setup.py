# SPDX-License-Identifier: Apache-2.0
"""Python metadata: the version comes from package.xml, the commands are listed here only.

``pip install .`` uses it for the core without ROS, hence without nodes; CMakeLists.txt asks it for
the scripts that ROS 2 runs.
"""

import os
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from setuptools import find_namespace_packages, setup

NAME = "tactile_resonance"
HERE = Path(__file__).resolve().parent
NODES = (
    "excitation_node",
    "frf_node",
    "poles_node",
    "contact_node",
    "scan_node",
    "scan_goal",
    "pole_map_node",
    "fake_hardware_node",
    "manager_node",
)
BUILT_FOR_ROS = "TACTILE_RESONANCE_BUILT_FOR_ROS" in os.environ  # set by CMakeLists.txt

manifest = ElementTree.parse(HERE / "package.xml").getroot()


def shared(folder):
    """Where setuptools installs each file of a folder: share/<name>/<folder>, as ROS 2 does."""
    grouped = {}
    for path in sorted((HERE / folder).rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            relative = path.relative_to(HERE)
            target = f"share/{NAME}/{relative.parent.as_posix()}"
            grouped.setdefault(target, []).append(relative.as_posix())
    return list(grouped.items())


OPTIONS = {}
if not BUILT_FOR_ROS:
    # metadata in the source tree would hide that of the ROS installation from its executables
    (HERE / "build").mkdir(exist_ok=True)
    OPTIONS = {"egg_info": {"egg_base": "build"}}

setup(
    name=NAME,
    options=OPTIONS,
    version=manifest.findtext("version"),
    description=" ".join(manifest.findtext("description").split()),
    license="Apache-2.0",
    author=manifest.findtext("maintainer"),
    author_email=manifest.find("maintainer").get("email"),
    packages=find_namespace_packages(include=[NAME, f"{NAME}.*"], exclude=["*.__pycache__"]),
    package_data={"": ["py.typed", "*.css", "*.html", "*.js", "*.json", "*.yaml"]},
    data_files=[
        *shared("config"),
        *shared("msg"),  # definitions for recordings made without ROS
        (f"share/{NAME}", ["package.xml"]),  # the version
    ],
    python_requires=">=3.10,<3.14",
    install_requires=[
        "numpy>=1.24,<3",
        "scipy>=1.10,<2",
        "numba>=0.56.4,<0.70",  # from that of Debian 12 on
        "matplotlib>=3.6,<4",
        "plotly>=5.15,<7",  # of which a report holds plotly.js
        "PyYAML>=6,<7",
        "tqdm>=4.60,<5",
    ],
    # what drives hardware is installed by those who have it
    extras_require={
        "nidaqmx": ["nidaqmx>=1.0,<2"],
        "robot": ["ur-rtde>=1.6.5,<1.7"],
        "can": ["python-can>=4.5,<5"],
        "mesh": ["trimesh>=4.5,<6"],
        "recording": ["rosbags>=0.11.1,<0.12"],
    },
    entry_points={
        "console_scripts": [
            f"{NAME} = {NAME}.cli:command",
            *(f"{node} = {NAME}.nodes.{node}:main" for node in NODES if BUILT_FOR_ROS),
        ]
    },
    zip_safe=False,
)
