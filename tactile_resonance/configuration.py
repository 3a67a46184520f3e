# SPDX-License-Identifier: Apache-2.0
"""Where the shared files (``config/``, ``launch/`` ...) are, in a source tree or installed."""

from __future__ import annotations

import os
import sys
from pathlib import Path

PACKAGE_NAME = "tactile_resonance"


def share_path(relative: str | Path) -> Path:
    """Return the path of a shared file or directory, e.g. ``share_path("config/tissues.yaml")``.

    Looked for, in this order: beside the package in the source tree; in
    ``share/tactile_resonance`` of every prefix in the environment variable ``AMENT_PREFIX_PATH``
    (the ament index, read without importing ament); in ``share/tactile_resonance`` of
    ``sys.prefix``.

    Parameters
    ----------
    relative : str or Path
        Path relative to the share directory; must not be absolute nor contain ``..``.

    Raises
    ------
    ValueError
        If `relative` is absolute or climbs out of the share directory.
    FileNotFoundError
        If no candidate exists; the message lists every place looked at.
    """
    relative = Path(relative)
    if relative.is_absolute() or ".." in relative.parts:
        raise ValueError(
            f"relative: got {str(relative)!r}; accepted is a path inside the share directory, "
            "such as 'config/tissues.yaml'"
        )
    prefixes = [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    installed = [Path(prefix) / "share" / PACKAGE_NAME for prefix in prefixes]
    candidates = [root / relative for root in (Path(__file__).resolve().parent.parent, *installed)]
    for candidate in candidates:
        if candidate.exists():
            return candidate
    places = "\n  ".join(str(candidate) for candidate in candidates)
    raise FileNotFoundError(f"shared file {str(relative)!r} not found; looked at:\n  {places}")


def package_version() -> str:
    """Version of this package, which stands in package.xml."""
    from xml.etree import ElementTree  # a node that does not ask need not load it

    return str(ElementTree.parse(share_path("package.xml")).findtext("version"))


def shared_file(path: Path, folder: str) -> Path:
    """Return a path as it is, or, for a bare name that is no file here, that of a shared folder.

    Raises
    ------
    ValueError
        If it is in neither place.
    """
    if len(path.parts) != 1 or path.is_file():
        return path
    try:
        return share_path(Path(folder) / path)
    except FileNotFoundError:
        raise ValueError(f"{path}: neither a file here nor one of {folder}") from None
