# SPDX-License-Identifier: Apache-2.0
"""Simulated hardware: the bimorph sensor, the tissue it touches, and the bench around them.

From the outside in: `bench` (blocks of samples), `scene` (what lies where), `library` (tissues),
`bimorph` (poles, zeros and response of the coupled sensor), `response` and `nonlinear` (its time
domain), `tissue` and `beam` (the physics), `indenter` (force against depth through time).
`plant` and `robot` are what a tip moves on; `plant_process` puts them on ports, `contact_bench` in
virtual time. Nothing simulated here is a measurement; sources of the parameters stand in ``config/``.
"""
