"""The values of one payload over all cells of a bake, folded into irradiance for one sun or one sky.

Comes in: the cells' payloads, and factors of their functions. Goes out: nine coefficients of three colours for each
data point. Factors are folded into the basis of each cell first, so a change of the sun costs 27 multiplications for
each stored coefficient.
"""

from __future__ import annotations

import numpy as np

from .payload import NO_DATA, Payload
from .transform import WIDTH

__all__ = ["Values"]


class Values:
    """One payload over all cells.

    Parameters
    ----------
    name : str
        Of the payload, for messages.
    payloads : list of Payload or None
        Of each cell; a cell without the payload has no data.
    first : (cells + 1,) int64
        Global index of each cell's first voxel, and the number of all.

    Attributes
    ----------
    functions : int
        Number of functions K.

    Raises
    ------
    ValueError
        For cells that hold different numbers of functions.
    """

    def __init__(self, name: str, payloads: list[Payload | None], first: np.ndarray):
        self._payloads, self._first = payloads, np.asarray(first, np.int64)
        counts = {payload.functions for payload in payloads if payload is not None}
        if len(counts) != 1:
            raise ValueError(f"the cells hold different numbers of functions in their {name} payloads")
        self.functions = counts.pop()

    def folded(self, factors: np.ndarray) -> np.ndarray:
        """Return the irradiance of each data point.

        Parameters
        ----------
        factors : (K, 3) float
            Factor of each function and colour.

        Returns
        -------
        (n, 27) float32
            Nine coefficients of three colours by global index; zeros where there is no data.
        """
        out = np.zeros((self._first[-1], WIDTH), np.float32)
        for payload, first in zip(self._payloads, self._first, strict=False):
            if payload is not None:
                known = np.flatnonzero(payload.index != NO_DATA)
                out[first + known] = payload.table.fold(factors)[payload.index[known]]
        return out
