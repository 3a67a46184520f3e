# SPDX-License-Identifier: Apache-2.0
"""Simulated hardware: the bimorph sensor, the tissue it touches, and the bench around them.

From the outside in: `bench` (blocks of samples), `scene` (what lies where), `library` (tissues),
`bimorph` (poles, zeros and response of the coupled sensor), `response` and `nonlinear` (its time
domain), `contact`, `tissue` and `beam` (the physics), `indenter` (force against depth through time,
for the robot's side) and `indentation` (relaxation tests in closed form).
Nothing simulated here is a measurement; sources of the parameters stand in ``config/``.
"""
