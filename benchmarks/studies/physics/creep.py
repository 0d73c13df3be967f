"""Creep of held presses and recovery after release.

Run by `python -m eitskin.benchmarks.studies.physics.creep`.

Prints, as Markdown, for the reference stack under the 15 mm cylinder, the layers' shares of the
force, how far one elastic force for the whole stack is from layers that relax each by themselves
(when all has relaxed: there the exact answer is the stack of relaxed moduli), depths over time, and
run times.
"""

import time

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.studies.physics.press_history import ForceHistory, Memory
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.provenance import Provenance
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress, Indentation
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.mechanics.viscoelasticity import (
    ECOFLEX,
    GEL,
    REFERENCE,
    Prony,
    elastic_force,
    elastic_force_at_depth,
    mixture,
)
from eitskin.simulator.scene.indenters import Cylinder

Array = NDArray[np.float64]

FORCES = (2.0, 5.0, 10.0)
GEL_LAYER = 1
HELD = 30.0
SEED = 0


def main() -> None:
    """Print the tables."""
    print(Provenance.now(SEED))
    shares()
    relaxed_stack()
    over_time()
    run_times()


def press(mechanics: Mechanics | None = None) -> AxisymmetricPress:
    """Press by the cylinder on the reference stack."""
    return AxisymmetricPress((mechanics or Mechanics()).stack(SensorDesign.reference()), Cylinder())


def shares() -> None:
    """Shares of the layers in the force, at the depths of some forces."""
    print("\n## share of the force\n")
    print(
        "| force | encapsulation below | gel | above | G at infinite time |\n|---|---|---|---|---|"
    )
    for force in FORCES:
        indented = press()
        parts = layer_shares(indented, indented.to_force(force).depth)
        both = mixture((ECOFLEX, GEL, ECOFLEX), parts)
        row = " | ".join(f"{part:.3f}" for part in parts)
        print(f"| {force:g} N | {row} | {float(both.relaxation(np.inf)):.4f} |")


def layer_shares(press: AxisymmetricPress, depth: float, step: float = 0.02) -> Array:
    """Share of the force at a depth [m] due to the shear modulus of each layer, (layers,).

    By F = dU/dd, (mu_k / F) dF/dmu_k is the part of the work of going deeper that layer k stores,
    here from presses to (1 -+ step) depth, with an error of order step^2. Energies of volume
    changes and of the contact, which do not relax, are left out; the shares add up to 1.
    """
    below, above = (press.to_depth(k * depth).energies for k in (1.0 - step, 1.0 + step))
    rise = above - below
    shares: Array = rise / rise.sum()
    return shares


def relaxed_stack() -> None:
    """Compare one elastic force with the stack of relaxed moduli under the same force."""
    gel, silicone = (float(material.relaxation(np.inf)) for material in (GEL, ECOFLEX))
    soft = Mechanics(NeoHookean(20e3 * gel), NeoHookean(28e3 * silicone))
    print("\n## all relaxed\n")
    print("| force | depth by the elastic force | thinner by | depth | gel thinner by |")
    print("|---|---|---|---|---|")
    for force in FORCES:
        elastic = force * float(REFERENCE.creep(np.inf))
        rows = press().to_force(elastic), press(soft).to_force(force)
        print(f"| {force:g} N | {described(rows[0])} | {described(rows[1])} |")


def over_time() -> None:
    """Print a press of 10 N while it is held, and after its release at HELD seconds."""
    force = FORCES[-1]
    print(f"\n## {force:g} N, held\n\n| held for | elastic force | depth | gel thinner by ", end="")
    print("| force at a held depth |\n|---|---|---|---|---|")
    for seconds in (0.0, 1.0, 10.0, 60.0, 1e5):
        elastic = elastic_force(REFERENCE, force, seconds)
        relaxed = force * float(REFERENCE.relaxation(seconds))
        print(
            f"| {seconds:g} s | {elastic:.2f} N | {described(press().to_force(elastic))} "
            f"| {relaxed:.2f} N |"
        )
    print(
        f"\n## {force:g} N, released after {HELD:g} s\n\n| since | elastic force | depth ", end=""
    )
    print("| gel thinner by | after as long at its depth |\n|---|---|---|---|---|")
    for seconds in (1.0, 10.0, 60.0, 300.0):
        elastic = elastic_force(REFERENCE, force, HELD, released=seconds)
        print(
            f"| {seconds:g} s | {elastic:.4f} N | {described(press().to_force(elastic), 3)} "
            f"| {elastic_force_at_depth(REFERENCE, force, HELD, released=seconds):.4f} N |"
        )


def run_times() -> None:
    """Run times of a creep function, of a long recording and of a frame."""
    start = time.perf_counter()
    for term in range(100):
        _ = Prony(REFERENCE.amplitudes, (*REFERENCE.times[:-1], 200.0 + term)).dual
    print(f"\n- creep function of five terms [ms]: {10 * (time.perf_counter() - start):.2f}")
    samples, frames = 1_000_000, 10_000
    rng = np.random.default_rng(SEED)
    history = ForceHistory(np.linspace(0.0, 2e4, samples), rng.uniform(0.0, 10.0, samples))
    start = time.perf_counter()
    history.elastic_force(REFERENCE, history.times)
    print(f"- recording of {samples} samples [s]: {time.perf_counter() - start:.2f}")
    start, memory = time.perf_counter(), Memory.none(REFERENCE)
    for _ in range(frames):
        memory = memory.after(0.02, 5.0)
        _ = memory.elastic_force
    print(f"- one frame [us]: {1e6 * (time.perf_counter() - start) / frames:.0f}")


def described(dent: Indentation, digits: int = 2) -> str:
    """Depth and thinning of the gel, two cells."""
    return f"{1e3 * dent.depth:.{digits}f} mm | {100 * dent.thinning(GEL_LAYER):.{digits}f} %"


if __name__ == "__main__":
    main()
