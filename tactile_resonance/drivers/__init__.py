# SPDX-License-Identifier: Apache-2.0
"""Hardware behind contracts: acquisition devices, later robot and load cell. No ROS here."""
