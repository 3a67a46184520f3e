# SPDX-License-Identifier: Apache-2.0
"""ROS 2 nodes: thin shells that turn messages into core objects and back. Nothing else imports rclpy."""
