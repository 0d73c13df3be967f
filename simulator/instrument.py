"""What the instrument adds to a noise-free frame."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry import ConfigurationError

Complex = NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class WhiteNoise:
    """White Gaussian noise on each quadrature of each measurement.

    Attributes:
        snr_db: how far the standard deviation per quadrature lies below full scale [dB].
    """

    snr_db: float = 75.0

    def __post_init__(self) -> None:
        """Check the number."""
        if not math.isfinite(self.snr_db):
            raise ConfigurationError(f"snr_db must be a finite number of dB, got {self.snr_db}")

    def deviation(self, full_scale: float) -> float:
        """Standard deviation per quadrature [ohm] for a full scale [ohm]."""
        return float(full_scale * 10.0 ** (-self.snr_db / 20.0))

    def apply(self, impedance: Complex, full_scale: float, rng: np.random.Generator) -> Complex:
        """`impedance` [ohm] with noise drawn from `rng`."""
        noise = rng.standard_normal((2, *impedance.shape)) * self.deviation(full_scale)
        noisy: Complex = impedance + noise[0] + 1j * noise[1]
        return noisy
