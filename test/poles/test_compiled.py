# SPDX-License-Identifier: Apache-2.0
"""What all compiled functions have in common."""

from numba import types

from tactile_resonance.poles import compiled


def test_none_returns_arrays():
    """One that does crashes Python where Ctrl-C comes meanwhile; see `compiled.entry`."""
    compiled.rehearse()
    returned = {
        (kernel.__name__, signature.return_type)
        for kernel in compiled.KERNELS
        for signature in kernel.nopython_signatures
    }
    assert returned == {(kernel.__name__, types.none) for kernel in compiled.KERNELS}
