"""A bar whose current is known everywhere, and the colours of a picture."""

import numpy as np

from eitskin.geometry import Electrode, Rectangle, SensorDesign

LENGTH, WIDTH, THICKNESS = 0.040, 0.010, 0.005


def bar_between_electrodes(contact_impedance=1e-9, conductivity=1.0) -> SensorDesign:
    """A bar between electrodes that cover its ends."""
    places = ((0.0, 0.5 * WIDTH), (LENGTH, 0.5 * WIDTH))
    ends = tuple(Electrode(x, y, WIDTH, contact_impedance) for x, y in places)
    return SensorDesign(
        Rectangle(LENGTH, WIDTH), THICKNESS, ends, conductivity, encapsulated_thickness=THICKNESS
    )


def colours(path) -> np.ndarray:
    """Colours of the pixels of an image file, (height, width, 3)."""
    from PIL import Image

    return np.asarray(Image.open(path).convert("RGB")).astype(int)
