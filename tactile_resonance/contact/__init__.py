# SPDX-License-Identifier: Apache-2.0
"""From a scan point to a quiet contact at the force asked for: estimation, control, safety. No I/O."""
