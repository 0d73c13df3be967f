"""Cases that are solved, most needed first."""

from dataclasses import replace

from eitskin.benchmarks.reference.case import Case
from eitskin.simulator.scene.indenters import Cylinder, Sphere

SINGLE = (
    (75.0, 15.0),
    (75.0, 7.5),
    (45.0, 30.0),
    (7.5, 30.0),
    (30.0, 30.0),
    (75.0, 10.0),
    (75.0, 5.0),
    (15.0, 30.0),
)
CORNERS = ((15.0, 15.0), (60.0, 15.0), (30.0, 15.0), (45.0, 15.0))  # without symmetry
FORCES = (2.0, 5.0, 8.0, 12.0)


def cases() -> list[Case]:
    """Cases of the reference."""
    found = [_at(75, 30), _at(60, 30), *(_at(*place) for place in SINGLE)]
    found += [
        Case("two_60_30_90_30", ((60.0, 30.0), (90.0, 30.0))),
        Case("two_65_30_85_30", ((65.0, 30.0), (85.0, 30.0))),
        Case("two_52.5_30_97.5_30", ((52.5, 30.0), (97.5, 30.0))),
        Case("four_30", ((60.0, 15.0), (90.0, 15.0), (60.0, 45.0), (90.0, 45.0))),
    ]
    found += [_at(75, 30, force=force) for force in FORCES]
    shapes = (
        ("ball_5", Sphere(0.005), 5.0),
        ("cylinder_3", Cylinder(0.003), 3.0),
        ("cylinder_10", Cylinder(0.010), 10.0),
    )
    for name, indenter, force in shapes:
        found.append(_renamed(_at(75, 30, force=force, indenter=indenter), name))
    found += [_at(*CORNERS[0]), _at(*CORNERS[1])]
    plates = [_at(45, 30), _at(75, 30, force=2.0), _at(75, 30), _at(45, 30, angle=30.0)]
    found += [_renamed(replace(case, support="plates"), "plates") for case in plates]
    for thickness in (0.8, 1.25):
        found.append(_renamed(_at(75, 30, thickness=thickness), f"thickness_{thickness:g}"))
    for ratio in (0.7, 2.8):
        found.append(_renamed(_at(75, 30, ratio=ratio), f"ratio_{ratio:g}"))
    found.append(_renamed(_at(75, 30, support="substrate"), "substrate"))
    found.append(_renamed(_at(75, 30, force=2.0, support="free"), "free"))
    found += [_at(*place) for place in CORNERS[2:]]
    found.append(Case("three", ((45.0, 30.0), (75.0, 30.0), (105.0, 30.0))))
    for angle in (-20.0, 20.0, 50.0):
        found.append(Case(f"bend_{angle:g}", (), 0.0, support="plates", angle=angle))
    for angle in (20.0, 50.0):
        # Between the plates 10 N bend the stack by twice its thickness.
        for x, y, force in ((75, 30, 2.0), (40, 30, 10.0), (30, 15, 10.0)):
            pressed = _at(x, y, force, support="plates", angle=angle)
            found.append(_renamed(pressed, "plates"))
    return found


def _at(x: float, y: float, force: float = 10.0, **changes: object) -> Case:
    """Case of one touch, named after position and force."""
    name = f"{x:g}_{y:g}" + ("" if force == 10.0 else f"_{force:g}N")
    return replace(Case(name, ((float(x), float(y)),), force), **changes)  # type: ignore[arg-type]


def _renamed(case: Case, prefix: str) -> Case:
    angle = f"_{case.angle:g}deg" if case.angle else ""
    return replace(case, name=f"{prefix}_{case.name}{angle}")
