# SPDX-License-Identifier: Apache-2.0
"""What poles tell of the tissue."""
