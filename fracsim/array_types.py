"""Types of arrays."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Pattern = npt.NDArray[np.uint8]  # (cells,) broken edges of each cell, a bit for each edge
