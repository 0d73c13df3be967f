"""Sizes, contrasts and contact impedances at the ends of their ranges, against closed forms."""

import dataclasses

import numpy as np
import pytest

from eitskin.benchmarks.stability.closed_forms import block, shunt_pair
from eitskin.benchmarks.stability.electrical import OUTLINE, SPANS, pair
from eitskin.benchmarks.stability.electrical import H as THICKNESS
from eitskin.geometry import Electrode, Layer, SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import ForwardModel, Protocol

from contacts import with_contacts


def resistance(design, order=(4,), finest=1e-6, growth=1.5, cells=None) -> complex:
    grading = Grading(finest, coarsest=2e-2, growth=growth, layers=1)
    model = ForwardModel(design, (order, grading), cells=cells)
    return Protocol.pairwise(2).measure(model.impedance())[0]


# Electrodes: tiny, huge, round corners

CASES = [
    *((name, None) for name in SPANS),
    *((name, "prisms") for name in ("10 um and 5 mm", "round one corner")),
]


@pytest.mark.parametrize(("name", "cells"), CASES)
def test_shunt_electrodes_of_any_size(name, cells) -> None:
    ends = np.ravel(SPANS[name])
    exact = shunt_pair(OUTLINE.length, OUTLINE.width, OUTLINE.at(ends).tolist())
    finest, growth, close = (1e-2, 1.0, 2e-4) if cells else (1e-3, 1.5, 1e-4)
    finest *= np.diff(ends).min()
    R = resistance(pair(SPANS[name], 1e-10), finest=finest, growth=growth, cells=cells)
    assert R * THICKNESS == pytest.approx(exact, rel=close)


# Contact impedances: mixed


@pytest.mark.parametrize("buried", [0, 3])
def test_a_buried_electrode_is_not_there(buried) -> None:
    """With z = 1e3 beside 1e-9 no current can pass it: the others see a sensor without it."""
    whole = with_contacts([1e3 if e == buried else 1e-9 for e in range(8)])
    rest = [e for e in range(8) if e != buried]
    with_it = ForwardModel(whole, "fast").impedance()
    without = dataclasses.replace(whole, electrodes=tuple(whole.electrodes[e] for e in rest))
    pairs = Protocol.pairwise(7)
    R = pairs.measure(with_it[np.ix_(rest, rest)])
    assert R == pytest.approx(pairs.measure(ForwardModel(without, "fast").impedance()), rel=1e-3)


# Layers: 100 to 1 in thickness, 1e-6 .. 1e6 in conductivity


def stack(ratio, thin, electrodes):
    """A layer of 1 S/m under one of `ratio` S/m, `thin` of the whole thickness."""
    layers = (Layer((1 - thin) * THICKNESS, 1.0), Layer(thin * THICKNESS, ratio))
    return SensorDesign(OUTLINE, THICKNESS, electrodes, layers=layers)


@pytest.mark.parametrize("thin", [0.5, 0.01])
@pytest.mark.parametrize("ratio", [1e-6, 1e6])
def test_layers_in_parallel(ratio, thin) -> None:
    """Above layers without contacts, below layers with contacts each of their own."""
    z = 1e-10
    ends = (Electrode(0.0, 0.03, 0.06, z), Electrode(0.15, 0.03, 0.06, z))
    R = resistance(stack(ratio, thin, ends), order=(2, 2, 2), finest=2e-2)
    area = 0.06 * THICKNESS
    low, high = (
        1
        / sum(
            1 / block(0.15, share * area, sigma, *contacts)
            for share, sigma in ((1 - thin, 1.0), (thin, ratio))
        )
        for contacts in ((), (z, z))
    )
    assert low * (1 - 1e-9) <= R <= high * (1 + 1e-9)
    assert high < low * (1 + 2e-3)


STACKS = [
    (z, ratio, thin) for z in (1e-9, 1e-3, 1e3) for ratio in (1e-6, 1e6) for thin in (0.5, 0.01)
]


@pytest.mark.parametrize(("z", "ratio", "thin"), STACKS)
def test_layers_in_series(z, ratio, thin) -> None:
    faces = tuple(Electrode(0.075, 0.03, 0.15, z, height=0.06, on=on) for on in ("top", "bottom"))
    R = resistance(stack(ratio, thin, faces), order=(1, 1), finest=2e-2)
    area = 0.15 * 0.06
    exact = THICKNESS * (1 - thin + thin / ratio) / area + 2 * z / area
    assert R == pytest.approx(exact, rel=1e-8)


@pytest.mark.parametrize("ratio", [1e-6, 1e6])
def test_contrast_with_electrodes_on_the_side(ratio) -> None:
    """Between all-insulating and all-conducting halves R stays between its two bounds."""
    forward = ForwardModel(SensorDesign.reference(), "fast")
    half = forward.mesh.points[forward.mesh.cells, 0].mean(axis=1) < 0.075
    pairs = Protocol.pairwise(8)
    R = pairs.measure(forward.impedance(np.where(half, 1.0, ratio)))
    uniform, scaled = (pairs.measure(forward.impedance(s)) for s in (1.0, ratio))
    low, high = np.minimum(uniform, scaled), np.maximum(uniform, scaled)
    assert np.all((low * (1 - 1e-9) <= R) & (R <= high * (1 + 1e-9)))
