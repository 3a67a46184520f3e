# SPDX-License-Identifier: Apache-2.0
"""Simulated hardware: the bimorph sensor, the tissue it touches, and the bench around them.

`sensor/`: `bench` (what the tip touches, blocks of samples), `bimorph` (modes, poles, zeros and response of the
coupled sensor), `response` and `nonlinear` (its time domain), `experiments` (records of several runs).
`tissue/`: `scene` (what lies where), `library` (tissues, and the contact that a small vibration sees),
`indenter` (force against depth through time).
`ur5e/`: the robot and its controller (`controller` is the whole), which know nothing of the rest.
`cell/`: the load cell (`transducer`) and its buses.
`plant/`: tip, tissue and cell on one clock; `contact_bench` moves them in virtual time, `tabletop` and
`simulated_robot` on the ports of real devices, in the time of `bench_time`.

Nothing simulated here is a measurement; sources of the parameters stand in ``config/``.
"""
