# SPDX-License-Identifier: Apache-2.0
"""Tissue from poles: classes, calls and their uncertainty."""
