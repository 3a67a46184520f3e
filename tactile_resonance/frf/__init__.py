# SPDX-License-Identifier: Apache-2.0
"""From sampled periods to the frequency response function with its covariance."""
