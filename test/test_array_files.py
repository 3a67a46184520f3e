# SPDX-License-Identifier: Apache-2.0
"""Files of arrays from anywhere: read what is wanted, or refuse in one line; this process stays alive."""

import io
import os
import re
import resource
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.sparse
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tactile_resonance.array_files import read_arrays

NAMES = ("u", "y")
# two fields of numbers, damaged: SciPy 1.17 ends with SIGSEGV or SIGABRT at it
DAMAGED = Path(__file__).with_name("damaged.mat")


def test_a_damaged_mat_file_does_not_end_this_process():
    with pytest.raises(ValueError, match=r"^damaged.mat: no .mat record \(\S[^\n]*\)$"):
        read_arrays(DAMAGED, NAMES)


def test_no_module_beside_a_mat_file_is_run(tmp_path, monkeypatch):
    (tmp_path / "scipy.py").write_text("raise SystemExit('run from the folder of the record')")
    scipy.io.savemat(tmp_path / "a.mat", {"u": np.arange(3)})
    monkeypatch.chdir(tmp_path)
    arrays, _ = read_arrays(Path("a.mat"), NAMES)
    np.testing.assert_array_equal(np.ravel(arrays["u"]), np.arange(3))


def test_what_is_not_wanted_is_neither_read_nor_in_the_way(tmp_path):
    np.savez(tmp_path / "a.npz", u=np.arange(3), text=np.array("x"), o=np.array([{}], object))
    scipy.io.savemat(tmp_path / "a.mat", {"u": np.arange(3), "text": "x", "o": {"a": 1}})
    for name in ("a.npz", "a.mat"):
        arrays, names = read_arrays(tmp_path / name, NAMES)
        assert set(names) == {"u", "text", "o"}
        np.testing.assert_array_equal(np.ravel(arrays["u"]), np.arange(3))
        assert read_arrays(tmp_path / name, ("text",))[0] == {}  # no numbers


def test_a_sparse_matrix_counts_as_no_numbers(tmp_path):
    """NumPy's files hold none: it would be kept as an object, and refused without the name of the file."""
    scipy.io.savemat(tmp_path / "a.mat", {"u": scipy.sparse.csc_matrix(np.eye(3)), "y": np.arange(3)})
    arrays, names = read_arrays(tmp_path / "a.mat", NAMES)
    assert (set(arrays), set(names)) == ({"y"}, {"u", "y"})


@pytest.mark.parametrize("size", [1 << 27, 1 << 40])
def test_an_array_that_promises_more_than_it_holds_takes_no_memory(tmp_path, size):
    header = io.BytesIO()
    head = {"descr": "<f8", "fortran_order": False, "shape": (size,)}
    np.lib.format.write_array_header_1_0(header, head)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("u.npy", header.getvalue() + b"\0" * 800)
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match="a.npz: no .npz record"):
        read_arrays(tmp_path / "a.npz", NAMES)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 1e5  # of a GB or more


def test_lines_without_end_and_devices_are_refused(tmp_path):
    (tmp_path / "a.csv").write_text("u,y\n" + "1" * 70_000)
    with pytest.raises(ValueError, match="a line of 65536 characters or more"):
        read_arrays(tmp_path / "a.csv", NAMES)
    (tmp_path / "zero.csv").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe.npz")
    for name in ("zero.csv", "pipe.npz"):
        with pytest.raises(ValueError, match=f"{name}: a folder or device"):
            read_arrays(tmp_path / name, NAMES)
    with (tmp_path / "huge.npz").open("wb") as file:
        file.truncate(5 << 30)
    with pytest.raises(ValueError, match=r"huge.npz: 5.4 GB, accepted are .* up to 4 GiB"):
        read_arrays(tmp_path / "huge.npz", NAMES)


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), suffix=st.sampled_from([".npz", ".csv"]))
def test_damaged_files_are_read_or_refused_in_one_line(tmp_path, data, suffix):
    path = tmp_path / f"a{suffix}"
    if suffix == ".npz":
        np.savez_compressed(path, u=np.arange(40.0), y=np.arange(40.0))
    else:
        table = np.column_stack([np.arange(40.0)] * 2)
        np.savetxt(path, table, delimiter=",", header="u,y")
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 5))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    refused = ""
    try:
        arrays, _ = read_arrays(path, NAMES)
    except ValueError as error:
        arrays, refused = {}, str(error)
    assert refused == "" or (refused.startswith(path.name) and len(refused.splitlines()) == 1)
    assert all(array.dtype.kind in "biufc" for array in arrays.values())


@pytest.mark.filterwarnings("error")
def test_a_header_without_numbers_is_refused_in_one_line(tmp_path):
    for content in ("u,y\n", "u,y\n\n \n"):
        (tmp_path / "a.csv").write_text(content)
        with pytest.raises(ValueError, match=r"a\.csv: no \.csv record \(no numbers under the header\)"):
            read_arrays(tmp_path / "a.csv", NAMES)


def test_numbers_are_no_names_of_columns(tmp_path):
    (tmp_path / "a.csv").write_text("0.1,1.0e-2\n0.2,2.0e-2\n")
    with pytest.raises(ValueError, match="its first line holds numbers.*expected a header line"):
        read_arrays(tmp_path / "a.csv", NAMES)


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        ("0.1,abc", "line 5: could not convert string 'abc' to float64"),
        ("0.1", "line 5: the number of columns changed from 2 to 1"),
    ],
)
def test_a_wrong_row_is_named_by_its_line_in_the_file(tmp_path, row, reason):
    (tmp_path / "a.csv").write_text(f"u,y\n\n0.1,1\n0.2,2\n{row}\n0.3,4\n")
    with pytest.raises(ValueError, match=re.escape(f"a.csv: no .csv record ({reason}); expected a header")):
        read_arrays(tmp_path / "a.csv", NAMES)


def test_a_mat_file_is_read_where_memory_is_limited_already(tmp_path):
    pytest.importorskip("resource")
    scipy.io.savemat(tmp_path / "a.mat", {"u": np.arange(3)})
    code = (
        "import resource, sys; from pathlib import Path\n"
        "resource.setrlimit(resource.RLIMIT_AS, (1 << 33, 1 << 33))\n"
        "from tactile_resonance.array_files import read_arrays\n"
        "print(read_arrays(Path(sys.argv[1]), ('u',))[1])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "a.mat"], capture_output=True, text=True, check=False
    )
    assert done.stdout == "['u']\n", done.stderr
