# SPDX-License-Identifier: Apache-2.0
"""Scans: what is wanted, where to touch, when it is enough, and the folder that keeps it all."""
