# SPDX-License-Identifier: Apache-2.0
"""From the frequency response function to poles with their covariance."""
