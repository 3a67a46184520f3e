# SPDX-License-Identifier: Apache-2.0
"""What the plant's process and those who start it agree on."""

READY = "simulated UR5e ready at"
"""Begins the line that says that all ports are open."""

PRIORITY = 30
"""SCHED_FIFO priority of the simulated controller, above the control loop's: a real one has its own cores."""

TABLE_IN_BASE = [-0.49, -0.13, 0.2, 0.0, 0.0, -1.5707963267948966]
"""Frame of a scene in the robot's base, position [m] and rotation vector [rad]: under the tip as the
simulated robot starts, x of the scene along its beam."""

HOST = "127.0.1.1"
"""Address at which the simulated robot answers where none is given."""

PATIENT_S = 0.06
PATIENT = {
    "limits.force_age_s": PATIENT_S,
    "limits.arm_age_s": PATIENT_S,
    "robot_config": "config/devices/ur5e_patient.yaml",
    "force_config": "can_patient.yaml",
}
"""Parameters of contact_node by which data may be older than on hardware: what stands still is a simulation
that shares its cores with all nodes."""
