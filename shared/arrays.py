"""Types of arrays, for annotations."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]
Float16 = NDArray[np.float16]
Int16 = NDArray[np.int16]
UInt8 = NDArray[np.uint8]
