# SPDX-License-Identifier: Apache-2.0
"""A simulated UR e-series controller: kinematics, motion, safety, the program that serves commands."""
