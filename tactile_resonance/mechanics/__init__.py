# SPDX-License-Identifier: Apache-2.0
"""Mechanical tests of tissue with a ball: relaxation, creep, load and unload, and what they say of it."""
