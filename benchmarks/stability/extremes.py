"""Cases of extreme stacks, indenters and bends, through the simulator as users call it.

Each compares the signal of a press at "fast", the norm of all relative changes, with an own finer
solution: half the cells under the indenter and in the finite stack, no table between, and the cells
of "standard". It is right within the error that the simulator states for it.
"""

import dataclasses
from collections.abc import Iterator
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.stability.case import Case, CaseValues
from eitskin.geometry import Bend, Clamp, Plates, Rectangle, SensorDesign
from eitskin.geometry.deformation.kinematics import Deformation, Displaced
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.simulator import Cylinder, Mechanics, Scene, Simulator, Sphere, Touch
from eitskin.simulator.bends.pressed_plates import held_by_plates
from eitskin.simulator.deformation.contact import DentField
from eitskin.simulator.deformation.dents import Dents
from eitskin.simulator.deformation.finite_stack import FiniteStack
from eitskin.simulator.deformation.pressed_sensor import PressedSensor
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, REFERENCE_RATIO
from eitskin.simulator.electrical.resolution import discretisation, suited_cells
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.fitted_plan import Contact
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.mechanics.stack_mesh import Fineness, stack_mesh
from eitskin.simulator.scene.scene import AnyIndenter

Array = NDArray[np.float64]

_OUTLINE = Rectangle(0.090, 0.050)
_SENSOR = SensorDesign(_OUTLINE, 0.005, uniform(_OUTLINE, 8))
_PLACE = (0.040, 0.022)
_CELL = 1.0 / 80.0  # finest of the axisymmetric press, over the radius
_FINER = Fineness(ends=0.15, sides=0.15, layers=3, rims=0.25)
_FINER_LOOSE = Fineness(ends=0.0, sides=0.0, layers=2, rims=0.07, growth=0.7)
_UNSTATED = 0.10  # error that is right where the simulator states none


def extremes(quick: bool) -> Iterator[Case]:
    """Cases of a press each on a small sensor, and on the reference sensor bent by its plates.

    Covers, moduli and indenters are extreme singly and together. With all three at once no press
    was ever compared, and each is refused, as is a thin cover that is much stiffer than the gel.
    """
    modulus, mechanics = Mechanics().gel.shear_modulus, Mechanics()
    thin = dataclasses.replace(_SENSOR, encapsulated_thickness=0.0056)
    # On the grid of solved stacks, so that each takes one table of dents instead of four.
    ratios = (REFERENCE_RATIO * 2.0**-7.5, REFERENCE_RATIO * 2.0**6.5)
    soft, stiff = (Mechanics(encapsulation=NeoHookean(k * modulus)) for k in ratios)
    covers = {"": _SENSOR, "cover of 0.3 mm": thin}
    # With the forces of the cylinder and of the ball [N].
    moduli = {
        "": (mechanics, 3.0, 0.2),
        "cover 127 times as stiff as the gel": (stiff, 5.0, 0.2),
        "gel 129 times as stiff as the cover": (soft, 0.3, 0.02),
    }
    flat: dict[str, tuple[SensorDesign, Mechanics, Touch]] = {}
    for (cover, design), (ratio, (materials, *forces)) in product(covers.items(), moduli.items()):
        indenters: dict[str, AnyIndenter] = {"": Cylinder(), "ball of 2 mm": Sphere(0.001)}
        for (ball, indenter), force in zip(indenters.items(), forces, strict=True):
            name = ", ".join(filter(None, (cover, ratio, ball)))
            flat[name] = design, materials, Touch(*_PLACE, force, indenter)
    del flat[""]
    too_much = Touch(*_PLACE, 1.0, Cylinder())
    flat["gel 129 times as stiff as the cover, 1 N"] = _SENSOR, soft, too_much
    for name, (design, materials, touch) in flat.items():
        if quick and name != "cover of 0.3 mm":
            continue
        solve = partial(_compare, design, materials, Scene(touches=(touch,)))
        if name.count(",") == 2 or (design is thin and materials is stiff):
            yield Case(name, solve, "refused", "was ever compared")
        else:
            yield Case(name, solve, None, error_limit=_UNSTATED)
    on_plates = dataclasses.replace(SensorDesign.reference(), support=Plates())
    at_place = {"12 N over a plate": (0.045, 12.0), "3 N over the gap": (0.075, 3.0)}
    for name, (x, force) in {} if quick else at_place.items():
        scene = Scene(Bend(50.0), (Touch(x, 0.030, force, Cylinder()),))
        solve = partial(_compare, on_plates, mechanics, scene)
        yield Case(f"{name} of plates at 50 deg", solve, None, error_limit=_UNSTATED)
    scene = Scene(Bend(50.0), (Touch(0.075, 0.030, 12.0, Cylinder()),))
    solve = partial(_compare, on_plates, mechanics, scene)
    yield Case("12 N over the gap of plates at 50 deg", solve, "refused", "never compared")


def _compare(design: SensorDesign, mechanics: Mechanics, scene: Scene) -> CaseValues:
    """Signal of a press against that of the finer solution."""
    sim = Simulator(design, "fast", mechanics=mechanics)
    (press,) = sim.presses(scene)
    bent = dataclasses.replace(scene, touches=())
    resting, pressed = (sim.measure(each).impedance.real for each in (bent, scene))
    touch = scene.touches[0]
    cells = suited_cells("standard", design)
    sizes = discretisation("standard", design, cells, touch.indenter)
    finer = Simulator(design, sizes, mechanics=mechanics)
    before = finer.measure(bent).impedance.real
    deformation = _finer(design, mechanics, touch, scene.bend.angle_deg)
    after = finer.simulate_deformation(deformation).impedance.real
    signal = after / before - 1.0
    error = float(np.linalg.norm(pressed / resting - 1.0 - signal) / np.linalg.norm(signal))
    stated = _UNSTATED if press.signal_error is None else press.signal_error
    if not error <= stated:
        raise ArithmeticError(f"{error:.1%} off the finer solution, {stated:.0%} stated")
    figures = {"refused": 0.0, "off a finer solution [%]": 100.0 * error}
    if press.signal_error is not None:
        figures["stated [%]"] = 100.0 * stated
    return CaseValues(
        error=error,
        figures=figures | {"deep [mm]": 1e3 * press.depth},
        reached=f"{1e3 * press.depth:.2f} mm deep, {press.force:g} N, signal of "
        f"{np.abs(signal).max():.2g}, {error:.1%} off the finer solution, "
        + (press.caution or f"{stated:.0%} stated"),
    )


def _finer(design: SensorDesign, mechanics: Mechanics, touch: Touch, angle: float) -> Deformation:
    """Deformation of the gel by a press with finer cells."""
    stack, outline = mechanics.stack(design), design.outline
    if not isinstance(outline, Rectangle):
        raise TypeError(f"expected a rectangle, got {outline}")
    plates = held_by_plates(design, Clamp(), mechanics, OWN_GRID, angle)
    sensor = PressedSensor(design, mechanics, plates=plates)
    state, frame = sensor.state, None
    if state is not None:
        (frame,) = sensor.frames(state, np.array([[touch.x, touch.y]]))
    radius = touch.indenter.rims[1]
    stretches = (1.0, 1.0) if frame is None else tuple(frame.stretches.tolist())
    contact = Contact(touch.x, touch.y, radius, stretches)
    fineness = _FINER if state is None else _FINER_LOOSE
    body = stack_mesh(outline, stack, mechanics, design.support, [contact], fineness)
    dent = AxisymmetricPress(stack, touch.indenter, finest=_CELL * radius).to_force(touch.force)
    field = DentField(touch.x, touch.y, touch.indenter, dent, frame)
    correction = Dents((), (FiniteStack(body, bend=state).correction([field]),))
    lift = np.array([0.0, 0.0, stack.levels[stack.gel]])

    def displacement(points: Array) -> Array:
        moved = field.evaluate((points + lift).reshape(-1, 3)).displacement.reshape(points.shape)
        moved = moved + correction.positions(points) - points
        return moved if sensor.bend is None else moved + sensor.bend.positions(points) - points

    def derivative(points: Array) -> Array:
        G = field.evaluate((points + lift).reshape(-1, 3)).gradient.reshape(*points.shape, 3)
        G = G + correction.gradient(points) - np.eye(3)
        return G if sensor.bend is None else G + sensor.bend.gradient(points) - np.eye(3)

    return Displaced(displacement, derivative)
