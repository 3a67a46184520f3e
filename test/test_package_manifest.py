# SPDX-License-Identifier: Apache-2.0
"""package.xml names all that is imported and launched, or says that it comes by pip."""

import ast
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
KEYS = {name: f"python3-{name}" for name in ("matplotlib", "numpy", "scipy", "tqdm", "yaml")}
KEYS |= {"tf2_ros": "tf2_ros_py", "contourpy": "python3-matplotlib"}  # which depends on contourpy
BY_PIP = {"can": "python-can", "numba": "numba", "rosbags": "rosbags", "nidaqmx": "nidaqmx"}
BY_PIP |= {"trimesh": "trimesh"} | dict.fromkeys(("dashboard_client", "rtde_control"), "ur-rtde")
TYPES_ONLY = {"typing_extensions"}
# What arrays have since numpy 2.0, and what the module has since then.
OF_NEW_ARRAYS = {"mT", "to_device"}
OF_NEW_NUMPY = {
    *("astype", "bitwise_count", "concat", "cumulative_prod", "cumulative_sum", "isdtype"),
    *("matrix_transpose", "matvec", "permute_dims", "pow", "trapezoid", "unique_all"),
    *("unique_counts", "unique_inverse", "unique_values", "unstack", "vecdot", "vecmat"),
}


def imported(folder):
    """Top-level names of all imports in a folder that are neither the standard library's nor our own."""
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            else:
                names = [node.module] if isinstance(node, ast.ImportFrom) else []
            for name in names:
                top = name.partition(".")[0]
                if top not in {*sys.stdlib_module_names, "tactile_resonance", *TYPES_ONLY}:
                    yield top


@pytest.fixture(scope="module")
def manifest():
    return (ROOT / "package.xml").read_text(encoding="utf-8")


@pytest.mark.parametrize("folder", ["tactile_resonance", "launch"])
def test_what_is_imported_is_named(manifest, folder):
    (by_pip,) = re.findall(r"<!-- By pip.*?-->", manifest, re.DOTALL)
    named = set(re.findall(r"<(?:exec_)?depend>(.*?)<", manifest))
    for name in sorted(set(imported(folder))):
        if name in BY_PIP:
            assert BY_PIP[name] in by_pip, name
        else:
            assert KEYS.get(name, name) in named, name


def test_nothing_needs_numpy_2():
    """setup.py asks for numpy 1.24; what is called in fits alone fails there only once a record needs it."""
    newer = set()
    for path in (ROOT / "tactile_resonance").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute):
                of_numpy = isinstance(node.value, ast.Name) and node.value.id == "np"
                if node.attr in (OF_NEW_NUMPY if of_numpy else OF_NEW_ARRAYS):
                    newer.add(f"{path.name}:{node.lineno} {node.attr}")
    assert not newer


def test_what_is_launched_is_named(manifest):
    launched = {"rviz2", "ros2bag", "rosbag2_storage_mcap", "ros2launch"}
    for path in (ROOT / "launch").glob("*.launch.py"):
        launched |= set(re.findall(r'\bpackage="(\w+)"', path.read_text(encoding="utf-8")))
    assert launched <= set(re.findall(r"<exec_depend>(.*?)<", manifest))


def test_the_licence_of_each_library_that_is_installed_is_on_its_page():
    page = (ROOT / "docs" / "quality.md").read_text(encoding="utf-8")
    table = page.partition("## Licences")[2].partition("## Threat")[0]
    rows = " ".join(re.findall(r"^\| ([^|]+) \|", table, re.MULTILINE)).lower()
    for path in ("requirements.in", "requirements-ros.in"):
        wanted = (ROOT / path).read_text(encoding="utf-8").splitlines()
        of_tests = {"pytest", "pytest-cov", "hypothesis", "mpmath", "mypy", "ruff"}
        tools = {"cmake", "colcon-common-extensions", "catkin_pkg", "empy"}
        for line in wanted:
            name = re.match(r"[\w.-]*", line).group()
            if name and not name.startswith("ros-") and name not in of_tests | tools:
                assert name in rows, name
