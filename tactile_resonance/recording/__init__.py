# SPDX-License-Identifier: Apache-2.0
"""Measured periods from files: what is read, how it is checked."""
