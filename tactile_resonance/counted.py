# SPDX-License-Identifier: Apache-2.0
"""Numbers of things in sentences."""


def counted(count: int, thing: str, plural: str = "") -> str:
    """``1 point``, ``3 points``; with a plural of its own where that is not the thing and an s."""
    return f"{count} {thing}" if count == 1 else f"{count} {plural or thing + 's'}"
