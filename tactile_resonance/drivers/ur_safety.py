# SPDX-License-Identifier: Apache-2.0
"""What modes and status bits of a Universal Robots controller forbid.

Numbers: Universal Robots, "Real-Time Data Exchange (RTDE) Guide".
"""

from __future__ import annotations

from tactile_resonance.contact.interfaces import ArmFault

ROBOT_RUNNING = 7
PROGRAM_STOPPED, PROGRAM_PLAYING = 1, 2
_ROBOT_MODES = {
    -1: "no controller", 0: "disconnected", 1: "confirm safety", 2: "booting", 3: "power off",
    4: "power on", 5: "idle, brakes closed", 6: "backdrive", 7: "running", 8: "updating firmware",
}  # fmt: skip
_STOPS = (
    (5, ArmFault.EMERGENCY_STOP, "system emergency stop"),
    (6, ArmFault.EMERGENCY_STOP, "robot emergency stop"),
    (7, ArmFault.EMERGENCY_STOP, "emergency stop"),
    (8, ArmFault.PROTECTIVE_STOP, "a safety limit was violated"),
    (9, ArmFault.PROTECTIVE_STOP, "the safety system has a fault"),
    (4, ArmFault.PROTECTIVE_STOP, "safeguard stop"),
    (2, ArmFault.PROTECTIVE_STOP, "protective stop"),
    (3, ArmFault.PROTECTIVE_STOP, "recovery mode"),
    (10, ArmFault.PROTECTIVE_STOP, "stopped by the safety system"),
)


def stop_fault(safety_bits: int, robot_mode: int) -> tuple[ArmFault, str] | None:
    """Return why the arm cannot move whatever program runs; None where it can."""
    for bit, fault, text in _STOPS:
        if safety_bits >> bit & 1:
            return fault, f"{text} (safety_status_bits {safety_bits:#x})"
    if robot_mode != ROBOT_RUNNING:
        name = _ROBOT_MODES.get(robot_mode, "unknown")
        return (
            ArmFault.PROGRAM_STOPPED,
            f"the robot is not running: robot_mode {robot_mode} ({name})",
        )
    return None


def motion_fault(
    safety_bits: int, robot_mode: int, runtime_state: int
) -> tuple[ArmFault, str] | None:
    """Return why no command would be followed; None where it would."""
    fault = stop_fault(safety_bits, robot_mode)
    if fault is None and runtime_state != PROGRAM_PLAYING:
        return (
            ArmFault.PROGRAM_STOPPED,
            f"the control program does not run (runtime_state {runtime_state}): its watchdog expired, or "
            "it was stopped at the robot",
        )
    return fault
