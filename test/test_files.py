# SPDX-License-Identifier: Apache-2.0
"""Files that are there whole or not at all."""

import errno
import os

import pytest

from tactile_resonance.files import write_whole


def test_a_disk_that_is_full_is_told_with_the_file_which_stays_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / "run.json"
    write_whole(path, b"before")

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # the system does not name the file of a write

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left on device") as told:
        write_whole(path, b"after")
    assert told.value.filename == str(path)
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]
