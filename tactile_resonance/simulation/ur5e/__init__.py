# SPDX-License-Identifier: Apache-2.0
"""A simulated UR5e with its e-series controller, stepped in robot time.

`controller.UrController` is the whole of it; `kinematics` to `machine` are the arm, `program` and its
commands what an RTDE client of ur_rtde talks to, `safety` and `outputs` what it sees of the rest.

What it is not: URScript is not interpreted (the client's control program is known by its name, other
programs are refused), paths with blends, teach mode, freedrive and direct torque are not modelled. The
arm has no dynamics beyond dead time, lag and vibration: nothing makes it deviate but force mode, no
collision is detected but by the measured force. Where the maker publishes no figure (force mode's
gains, the threshold of tool contact, servoj's gain, currents) the model's own stands beside its name.
"""
