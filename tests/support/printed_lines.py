"""Lines printed by a text board, and their times."""

import cmath
import math

from eitskin.simulator import Protocol

PROTOCOL = Protocol.pairwise(4)  # six lines a frame
LINE, PAUSE = 0.0106, 0.06  # s
PERIOD = 6 * LINE + PAUSE


def printed(values, first="Freq:40000.00 "):
    """As the example program AD5940_Impedance prints them."""
    polar = [(abs(z), math.degrees(cmath.phase(z))) for z in values]
    lines = [f"RzMag: {size:f} Ohm , RzPhase: {phase:f} \n" for size, phase in polar]
    return [first + lines[0], *lines[1:]]
