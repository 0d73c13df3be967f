"""What the layers of a stack contribute to the force on an indenter."""

import numpy as np
from numpy.typing import NDArray

from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress

Array = NDArray[np.float64]


def layer_shares(press: AxisymmetricPress, depth: float, step: float = 0.02) -> Array:
    """How much of the force at a depth [m] the shear modulus of each layer accounts for, (layers,).

    By F = dU/dd, (mu_k / F) dF/dmu_k is the part of the work of going deeper that layer k stores,
    here from presses to (1 -+ step) depth, with an error of order step^2. What is stored in
    changes of volume and at the contact, which do not relax, is left out; the rest adds up to 1.
    """
    below, above = (press.to_depth(k * depth).energies for k in (1.0 - step, 1.0 + step))
    rise = above - below
    shares: Array = rise / rise.sum()
    return shares
