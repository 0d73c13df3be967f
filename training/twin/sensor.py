"""Sensor, fixture and materials of a twin's numbers."""

import dataclasses
from collections.abc import Mapping

from eitskin.datasets.recipe.specimen import (
    Specimen,
    free_length,
    moved_along_rim,
    moved_fixture,
    scaled_conductivity,
    scaled_modulus,
    scaled_thickness,
    with_wider_gap,
)
from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.electrode_shift import electrode_shift
from eitskin.geometry.deformation.fixtures import Clamp, FreeArc
from eitskin.simulator.mechanics.materials import NeoHookean, Ogden
from eitskin.training.twin.parameters import conductivity

Numbers = Mapping[tuple[str, int | None], float]
"""Numbers of sensor and fixture by kind and electrode."""


def centred(nominal: Specimen) -> Specimen:
    """The same sensor, about whose numbers bends and presses are interpolated.

    Raises ConfigurationError for sensors whose specimens cannot share a mesh.
    """
    design, fixture, mechanics = nominal.design, nominal.fixture, nominal.mechanics
    if any(complex(each.contact_impedance).imag for each in design.electrodes):
        raise ConfigurationError(
            "a twin needs real contact impedances, got complex ones; give their real parts"
        )
    if electrode_shift(design, design) is None:
        raise ConfigurationError(
            "a twin needs a plane outline, got a surface; give a flat sensor's rim as outline"
        )
    if isinstance(fixture, Clamp):
        held = fixture.solved_offset
        fixture = dataclasses.replace(
            fixture,
            solved_span=fixture.solved_span or fixture.span,
            solved_offset=fixture.offset if held is None else held,
        )
    elif not fixture.transition:
        raise ConfigurationError(
            "the bend of a kinematic fixture without transition jumps where it ends, and every "
            "span needs another mesh; give a clamp, or a transition"
        )
    ratio = mechanics.encapsulation.shear_modulus / mechanics.gel.shear_modulus
    mechanics = dataclasses.replace(
        mechanics,
        solved_thickness=mechanics.solved_thickness or design.thickness,
        solved_ratio=mechanics.solved_ratio or ratio,
    )
    return Specimen(design, fixture, mechanics)


def with_numbers(nominal: Specimen, numbers: Numbers) -> Specimen:
    """Nominal sensor with other numbers.

    Raises ConfigurationError for a sensor that cannot be, or cannot share the nominal one's mesh.
    """
    design, fixture, mechanics = nominal.design, nominal.fixture, nominal.mechanics
    electrodes = tuple(
        dataclasses.replace(
            moved_along_rim(each, numbers.get(("electrode_place", k), 0.0), design),
            contact_impedance=numbers["contact_impedance", k],
        )
        for k, each in enumerate(design.electrodes)
    )
    wider = numbers.get(("span", None), free_length(fixture)) - free_length(fixture)
    made = dataclasses.replace(
        design, electrodes=electrodes, support=with_wider_gap(design.support, wider)
    )
    made = scaled_conductivity(made, numbers["conductivity", None] / conductivity(design))
    made = scaled_thickness(made, numbers["thickness", None] / design.thickness)
    if electrode_shift(design, made) is None:
        raise ConfigurationError("an electrode meets another one or a corner")
    offset = 0.0 if isinstance(fixture, FreeArc) else fixture.offset
    deeper = numbers.get(("offset", None), offset) - offset
    materials = dataclasses.replace(
        mechanics,
        gel=_of_modulus(mechanics.gel, numbers["gel_modulus", None]),
        encapsulation=_of_modulus(mechanics.encapsulation, numbers["encapsulation_modulus", None]),
    )
    return Specimen(made, moved_fixture(fixture, wider, deeper), materials)


def _of_modulus(law: NeoHookean | Ogden, modulus: float) -> NeoHookean | Ogden:
    return scaled_modulus(law, modulus / law.shear_modulus)
