# SPDX-License-Identifier: Apache-2.0
"""A headless browser for a test; without one the test is skipped."""

import pytest

from tools.browser import NAMES, Browser, find


def browser():
    """Context of a page, see `tools.browser.Browser`."""
    if find() is None:
        pytest.skip(f"no browser is here: none of {', '.join(NAMES)} is installed")
    return Browser()
