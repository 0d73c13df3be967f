"""Volume ratios of axisymmetric presses and of their tables at 40 % thinning.

Run by `python -m eitskin.benchmarks.studies.physics.volume_ratios`.

Prints, as Markdown, the least and greatest J of the gel: of the press at its quadrature points, in
the mean over its cells, and of the table, a polynomial over the height.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.sensor import SensorDesign
from eitskin.provenance import Provenance
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.presses.press_table import solve_table
from eitskin.simulator.scene.indenters import Cylinder, Sphere

Array = NDArray[np.float64]

_THINNING, _STEP = 0.4, 0.02  # of the gel; of the depth over the thickness of the stack
_CELL = 1.0 / 40.0
CASES: dict[str, tuple[float, Cylinder | Sphere]] = {
    "3.5 mm encapsulation, cylinder of 15 mm": (12e-3, Cylinder()),
    "3.5 mm encapsulation, cylinder of 5 mm": (12e-3, Cylinder(2.5e-3)),
    "0.5 mm encapsulation, cylinder of 15 mm": (6e-3, Cylinder()),
    "bare gel, cylinder of 15 mm": (5e-3, Cylinder()),
    "bare gel, ball of 10 mm": (5e-3, Sphere(5e-3)),
}


def ratios(thickness: float, indenter: Cylinder | Sphere) -> tuple[Array, Array, Array]:
    """J of a press at its quadrature points, J in its cells, and J of its table.

    Args:
        thickness: of the stack [m].
        indenter: that presses.
    """
    design = replace(SensorDesign.reference(), encapsulated_thickness=thickness)
    stack = Mechanics().stack(design)
    press = AxisymmetricPress(stack, indenter, finest=_CELL * indenter.rims[1])
    for part in np.arange(_STEP, 0.8, _STEP):
        found = press.to_depth(part * thickness)
        if found.thinning(stack.gel) >= _THINNING:
            break
    cells = press.solid.cells_of_law[stack.gel]
    at_points, weights = press.solid.volume_ratio(press.unknowns), press.solid.weights[cells]
    in_cells = (at_points[cells] * weights).sum(axis=1) / weights.sum(axis=1)
    dent = solve_table(stack, stack.gel, indenter).at_depth(found.depth)
    r = np.linspace(0.05e-3, 1.6 * indenter.rims[1], 800)
    z = np.broadcast_to(np.linspace(0.02, 0.98, 60) * design.thickness, (len(r), 60))
    u, _, u_z, w_z, u_r, w_r = np.moveaxis(dent.motion(r, z), 1, 0)
    tabulated = (1.0 + u / r[:, None]) * ((1.0 + u_r) * (1.0 + w_z) - u_z * w_r)
    return at_points[cells], in_cells, tabulated


def main() -> None:
    """Print the table."""
    print(Provenance.now(seed=0))
    print(
        "\n| stack and indenter | J of the press, points | J of the press, cells | J of the table |"
    )
    print("|---" * 4 + "|")
    for name, case in CASES.items():
        spans = [f"{J.min():.3f} to {J.max():.3f}" for J in ratios(*case)]
        print(f"| {name} | " + " | ".join(spans) + " |", flush=True)


if __name__ == "__main__":
    main()
