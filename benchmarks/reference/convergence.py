"""Convergence of the 3D reference by refinement.

Run by `python -m eitskin.benchmarks.reference.convergence`; needs the extra `reference`.

Prints, as Markdown, for some cases how far the relative changes of the 28 resistances are from
those of the finest discretisation, over their norm: with displacements of order 3 and 4, finer
triangles everywhere or along the rim of the contact, and more layers.
"""

import argparse
import time

import numpy as np

from eitskin.benchmarks.reference.case import Case
from eitskin.benchmarks.reference.cases import cases
from eitskin.benchmarks.reference.pressed_reference import Numerics, ReferenceStack
from eitskin.benchmarks.reference.prisms import Sizes
from eitskin.benchmarks.reference.run import Gauge
from eitskin.extras import require_all
from eitskin.provenance import Provenance

CASES = ("75_30", "75_15")
# The last is what the others are compared with.
REFINED = {
    "order 3": Numerics(order=3),
    "order 4, rim of 2 mm": Numerics(sizes=Sizes(rim=2.0, inside=3.0)),
    "order 4, as used": Numerics(),
    "order 4, two layers": Numerics(layers=(4, 2, 2, 2)),
    "order 4, rim of 0.7 mm": Numerics(sizes=Sizes(rim=0.7)),
    "order 4, finer everywhere": Numerics(sizes=Sizes(rim=0.8, inside=2.0, around=3.5, far=6.0)),
}


def print_case(case: Case, gauge: Gauge, refined: dict[str, Numerics]) -> None:
    """Print the table of one case."""
    rows, changes = [], []
    for name, numerics in refined.items():
        start = time.process_time()
        stack = ReferenceStack(case, numerics)
        stack.solve()
        seconds = time.process_time() - start
        changes.append(gauge.changes(stack))
        rows.append((name, stack.solid.unknowns, f"{seconds:.0f}", f"{stack.depths[0]:.3f}"))
    print(f"\n{case.name}\n\n| discretisation | unknowns | s | depth [mm] | apart [%] |")
    print("|---" * 5 + "|")
    for row, change in zip(rows, changes, strict=True):
        apart = 100.0 * np.linalg.norm(change - changes[-1]) / np.linalg.norm(changes[-1])
        print("| " + " | ".join(map(str, (*row, f"{apart:.2f}"))) + " |", flush=True)


def main() -> None:
    """Print the tables."""
    require_all(reference="ngsolve netgen")
    options = argparse.ArgumentParser(description="Convergence of the 3D reference.")
    options.add_argument("--only", nargs="*", default=CASES, help="names of cases")
    options.add_argument("--resolution", default="fine", help="of the forward model")
    options.add_argument("--refined", nargs="*", default=list(REFINED), help="of `REFINED`")
    chosen = options.parse_args()
    found = {case.name: case for case in cases()}
    print(Provenance.now(seed=0))
    for name in chosen.only:
        gauge = Gauge(found[name].design(), chosen.resolution)
        print_case(found[name], gauge, {key: REFINED[key] for key in chosen.refined})


if __name__ == "__main__":
    main()
