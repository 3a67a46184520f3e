# SPDX-License-Identifier: Apache-2.0
"""What the tests of the client's commands share."""

import numpy as np
from scipy.spatial.transform import Rotation

# Dead time and lag of the joints are over after this long, to nanometres.
SETTLED_S = 0.2


def apart(pose, other) -> np.ndarray:
    """Position (3,) and rotation vector (3,) between two poses."""
    turn = Rotation.from_rotvec(pose[3:]) * Rotation.from_rotvec(other[3:]).inv()
    return np.concatenate([pose[:3] - other[:3], turn.as_rotvec()])


def unpacked(word: int) -> tuple[int, int, bool]:
    """Operation, write count and running flag of the asynchronous progress word."""
    return word >> 24 & 127, word >> 16 & 127, bool(word >> 15 & 1)
