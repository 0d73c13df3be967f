"""Layouts and bounds that cost nothing, or little."""

from dataclasses import replace

import numpy as np

from eitskin.benchmarks.layouts.bound import Sampling, SheetBound
from eitskin.benchmarks.layouts.candidates import with_electrodes
from eitskin.geometry import SensorDesign

FEW = Sampling(0.0675)  # 3 x 2 places
FEWEST = Sampling(0.135, resolution="coarse")  # 2 x 2 places


def moved(first=0.02):
    """The paper's layout with its first electrode elsewhere, which no mirror leaves alone."""
    electrodes = SensorDesign.reference().electrodes
    return with_electrodes("moved", [replace(electrodes[0], x=first), *electrodes[1:]])


def flat_bound(value, signal=(1.0,), spectrum=(4.0, 2.0, 0.5)):
    place = np.full((1, 1), value)
    return SheetBound(
        np.zeros(1), np.zeros(1), place, place, place, place, np.array([signal]), 0.1, 800.0,
        np.array(spectrum),
    )  # fmt: skip
