# SPDX-License-Identifier: Apache-2.0
"""What no test of nodes may leave behind."""

import sys

import pytest


@pytest.fixture(autouse=True)
def no_open_context(monkeypatch):
    """An open context that is dropped ends Python with a segmentation fault at an interrupt of a later test."""
    opened = []
    if rclpy := sys.modules.get("rclpy"):
        init = rclpy.Context.init

        def note(context, *args, **options):
            opened.append(context)
            init(context, *args, **options)

        monkeypatch.setattr(rclpy.Context, "init", note)
    yield
    left = [context for context in opened if context.ok()]
    for context in left:
        context.shutdown()
    assert not left
