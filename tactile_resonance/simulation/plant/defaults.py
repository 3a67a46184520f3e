# SPDX-License-Identifier: Apache-2.0
"""What the plant's process and those who start it agree on."""

READY = "simulated UR5e ready at"
"""First words of the line that is printed when all ports are open."""

PRIORITY = 30
"""SCHED_FIFO priority of the simulated controller, above the control loop's: a real one has its own cores."""

TABLE_IN_BASE = [-0.49, -0.13, 0.2, 0.0, 0.0, -1.5707963267948966]
"""Frame of a scene in the robot's base, position [m] and rotation vector [rad]: under the tip as the
simulated robot starts, x of the scene along its beam."""

STALLS_S = 0.05
"""So long a simulated robot without that priority may stand still on the wall clock, and be waited for."""

HOST = "127.0.1.1"
"""Address at which the simulated robot answers where none is given."""

CAN_PORT = 29536
"""Of the socketcand server of the simulated load cell, at the robot's address."""
