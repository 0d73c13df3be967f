"""Rule by which the regularisation parameter lambda of a picture is chosen."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import LEAST, MOST
from eitskin.errors import ConfigurationError
from eitskin.training.reconstruction.regularised_inverse import RegularisedInverse

Array = NDArray[np.float64]
RuleName = Literal["noise-figure", "snr", "gcv", "lambda"]


@dataclass(frozen=True, slots=True)
class Regularisation:
    """Rule for lambda, with its number.

    noise-figure: pictures lose this factor of signal to noise against the data; needs no frames
    (Adler and Guardo 1996; Graham and Adler 2006).
    snr: the MAP estimate for a signal-to-noise ratio of the frames.
    gcv: generalised cross-validation of the frames themselves; its number is not used.
    lambda: the parameter itself, for data as `Reconstructor.data` makes them.

    Attributes:
        rule: its name.
        value: its number, positive.
    """

    rule: RuleName = "noise-figure"
    value: float = 1.0

    def __post_init__(self) -> None:
        if self.rule not in get_args(RuleName) or not LEAST <= self.value <= MOST:
            raise ConfigurationError(
                f"expected a rule for lambda of {', '.join(get_args(RuleName))} with a "
                f"number from {LEAST:g} to {MOST:g}, got {self.rule!r} with {self.value!r}"
            )

    @classmethod
    def named(cls, text: str) -> "Regularisation":
        """Rule of a text: `noise-figure:1`, `snr:100`, `gcv`, or `lambda:0.01`."""
        name, colon, number = text.partition(":")
        try:
            if name not in get_args(RuleName) or bool(colon) == (name == "gcv"):
                raise ValueError
            return cls(name, float(number) if colon else 1.0)  # type: ignore[arg-type]
        except ValueError as error:
            raise ConfigurationError(
                "expected a rule for lambda as noise-figure:1, snr:100, gcv or lambda:0.01, got "
                f"'{text}'"
            ) from error

    def choose(self, family: RegularisedInverse, response: Array, data: Array) -> float:
        """Regularisation parameter lambda for a family of reconstructions.

        Args:
            family: the reconstructions.
            response: noise-free data of a small target in the middle (measurements,).
            data: of the frames, without missing channels (n, measurements).
        """
        if self.rule == "noise-figure":
            return family.of_noise_figure(self.value, response)
        if self.rule == "snr":
            return family.of_snr(self.value)
        return family.of_gcv(data) if self.rule == "gcv" else self.value
