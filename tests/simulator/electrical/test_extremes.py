"""Sizes, contrasts and contact impedances at the ends of their ranges, against closed forms."""

import dataclasses

import numpy as np
import pytest

from eitskin.benchmarks.stability import electrical
from eitskin.benchmarks.stability.case import judge
from eitskin.simulator import ForwardModel, Protocol

from contacts import with_contacts

CASES = {
    case.name: case
    for case in (
        *electrical.contrasts((1e-6, 1e6)),
        *electrical.layers((1e-6, 1e6), (0.5, 0.01)),
        *electrical.contacts(),
        *electrical.electrodes(quick=False),
    )
    if not case.name.startswith(("half a sensor", "2 mm high")) and "but 1e6" not in case.name
}


@pytest.mark.parametrize("name", CASES)
def test_cases_of_the_benchmark_have_their_closed_forms_or_are_refused(name) -> None:
    row = judge(CASES[name])
    assert row["outcome"] in ("ok", "refused"), row["reason"]


@pytest.mark.parametrize("buried", [0, 3])
def test_a_buried_electrode_is_not_there(buried) -> None:
    """With z = 1e3 beside 1e-9 no current can pass it: the others see a sensor without it."""
    whole = with_contacts([1e3 if e == buried else 1e-9 for e in range(8)])
    rest = [e for e in range(8) if e != buried]
    with_it = ForwardModel(whole, "coarse").impedance()
    without = dataclasses.replace(whole, electrodes=tuple(whole.electrodes[e] for e in rest))
    pairs = Protocol.pairwise(7)
    R = pairs.measure(with_it[np.ix_(rest, rest)])
    assert R == pytest.approx(pairs.measure(ForwardModel(without, "coarse").impedance()), rel=5e-3)
