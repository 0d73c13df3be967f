"""Many scenes of one mesh through the same block elimination at once, by torch.

Where `BlockCholesky.congruence` eliminates one matrix strip by strip, here each strip is a stack of
blocks, one per scene: on a graphics processor that keeps it busy, on others it saves calls.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.extras import require
from eitskin.simulator.electrical.cem_system import System
from eitskin.simulator.linalg.block_cholesky import BlockCholesky

Array = NDArray[np.float64]


def impedances(solver: BlockCholesky, systems: Sequence[System], device: str = "cpu") -> Array:
    """Electrode impedance matrices [ohm], (systems, electrodes, electrodes), as one by one.

    Args:
        solver: that the systems' values were made for.
        systems: real ones.
        device: of torch, such as "cpu" or "cuda".

    Raises:
        ConfigurationError: for a device that is not there, and for matrices that are not positive
            definite to rounding.
        ImportError: without torch; it names the extra to install.
    """
    torch = require("torch", "training")
    sums = np.stack([solver.sums(system.values) for system in systems])
    B = np.stack([system.coupling for system in systems])
    try:
        at = torch.device(device)
        T = _congruences(
            torch, solver, torch.as_tensor(sums, device=at), torch.as_tensor(B, device=at)
        )
    except torch.linalg.LinAlgError as error:
        raise ConfigurationError(
            f"a matrix of the batch is not positive definite to rounding ({error}); conductivities "
            "or contact impedances differ by more orders of magnitude than double precision holds"
        ) from error
    except (RuntimeError, AssertionError) as error:
        raise ConfigurationError(
            f"torch cannot compute on the device '{device}': {error}; use 'cpu', or a build of "
            "torch for the device"
        ) from error
    found = T.cpu().numpy()
    return np.stack(
        [np.real(system.impedance(one)) for system, one in zip(systems, found, strict=True)]
    )


def _congruences(torch: Any, solver: BlockCholesky, sums: Any, B: Any) -> Any:
    """B^T A^-1 B, (scenes, k, k), of added-up values (scenes, m) and B (scenes, n, k)."""
    total, carried, load = 0.0, None, None
    for strip in solver.strips:
        size = len(strip.unknowns)
        flat = sums.new_zeros(len(sums), size**2 + strip.below * strip.carried)
        flat[:, torch.as_tensor(strip.places, device=sums.device)] = sums[:, strip.values]
        # Stored column by column, the lower triangle filled: rows of the upper one, here.
        own = flat[:, : size**2].reshape(-1, size, size).mT
        right = B[:, torch.as_tensor(strip.unknowns, device=B.device)]
        if carried is not None:
            own, right = own - carried, right - load
        factor = torch.linalg.cholesky(own)
        half = torch.linalg.solve_triangular(factor, right, upper=False)
        total = total + half.mT @ half
        if strip.below:
            below = flat[:, size**2 :].reshape(-1, strip.carried, strip.below)
            corner = factor[:, size - strip.carried :, size - strip.carried :]
            joined = torch.linalg.solve_triangular(corner, below, upper=False).mT
            carried, load = joined @ joined.mT, joined @ half[:, size - strip.carried :]
    return total
