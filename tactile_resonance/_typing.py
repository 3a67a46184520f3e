# SPDX-License-Identifier: Apache-2.0
"""Arrays by the type of their elements; docstrings give their shapes."""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
