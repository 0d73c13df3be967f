"""The reference sensor with other contact impedances."""

import dataclasses

import numpy as np

from eitskin.geometry import SensorDesign


def with_contacts(z) -> SensorDesign:
    """The reference sensor with contact impedance `z`, one or one of each electrode [ohm m2]."""
    design = SensorDesign.reference()
    pairs = zip(design.electrodes, np.broadcast_to(z, 8).tolist(), strict=True)
    electrodes = tuple(dataclasses.replace(e, contact_impedance=one) for e, one in pairs)
    return dataclasses.replace(design, electrodes=electrodes)
