"""`eitskin simulate SCENE.toml`: impedances and picture of one scene."""

import dataclasses
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Group
from rich.table import Column, Table

from eitskin.cli.options import (
    Detail,
    Output,
    SceneFile,
    SensorOptions,
    electrode_pair,
    one_of,
    read_design,
    with_output,
)
from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    from eitskin.frame import Frame
    from eitskin.simulator.instrument.instrument import Instrument
    from eitskin.simulator.scene.scene import PressedTouch, Scene
    from eitskin.simulator.simulator import Simulator
    from eitskin.simulator.view.scene_pictures import Colour


@with_output
def command(
    scene: SceneFile,
    *,
    sensor: SensorOptions,
    resolution: Detail = "standard",
    noise: Annotated[
        float | None, typer.Option(help="Add white noise this many dB below full scale.")
    ] = None,
    instrument: Annotated[
        str | None,
        typer.Option(help="Board that measures: ideal, ad5940, or an instrument file."),
    ] = None,
    support: Annotated[
        str | None,
        typer.Option(help="rigid, plates or free, instead of the scene's or the sensor's."),
    ] = None,
    view: Annotated[Path | None, typer.Option(help="Draw the scene into this PNG file.")] = None,
    colour: Annotated[
        str | None, typer.Option(help="Colour of the picture: conductance, strain or current.")
    ] = None,
    drive: Annotated[
        str | None,
        typer.Option(
            help="Current from A to B, as A-B; the pair with the largest change when omitted."
        ),
    ] = None,
    seed: int = 0,
    output: Output,
) -> None:
    """Simulate one scene: impedances, their change from the flat sensor, depth of touches."""
    import numpy as np

    from eitskin.simulator.electrical.resolution import Resolution
    from eitskin.simulator.scene.scene import Scene
    from eitskin.simulator.view.scene_pictures import draw_scenes

    what = on_support(Scene.from_toml(scene), support)
    board = _instrument(noise, instrument)
    design = read_design(sensor.sensor)
    colours, pair = _colours(view, colour, drive, len(design.electrodes))
    sim = sensor.simulator(one_of("--resolution", resolution, Resolution), design)
    sim.check_scene(what)  # before its presses are solved, which takes minutes
    flat = sim.measure(Scene(), _noise_free(board), np.random.default_rng(seed))
    announce_unsolved(sim, what, output)
    start = time.perf_counter()
    frame = sim.measure(what, board, np.random.default_rng(seed))
    seconds = time.perf_counter() - start
    output.detail(f"{sim.model.solver.name}, {len(sim.model.mesh.cells)} cells, {seconds:.3f} s")
    presses = sim.presses(what)
    data = _as_data(frame, flat, seconds) | {"touches": [_touch_data(one) for one in presses]}
    shown = [_as_table(frame, flat), *([_touch_table(presses)] if presses else [])]
    output.result(data, Group(*shown, *_cautions(presses)))
    if view is not None:
        draw_scenes(sim, [(_title(scene.stem, what), what)], view, colours, pair)
        output.note(f"picture: {view}")


def _instrument(noise: float | None, name: str | None) -> "Instrument | None":
    """Instrument model: white noise, a named board, that board with other noise, or none."""
    from eitskin.simulator.instrument.instrument import Instrument

    if name is None:
        return None if noise is None else Instrument(noise)
    board = Instrument.named(name)
    return board if noise is None else dataclasses.replace(board, snr_db=noise)


def _noise_free(board: "Instrument | None") -> "Instrument | None":
    """Circuit and reading of a board, by which the flat sensor's values are those of its frames."""
    from eitskin.simulator.instrument.instrument import Instrument

    if board is None or board.meter is None:
        return None
    return Instrument(snr_db=0.0, meter=board.meter)


def _colours(
    view: Path | None, colour: str | None, drive: str | None, electrodes: int
) -> "tuple[Colour, tuple[int, int] | None]":
    """Colour scale and drive of the picture, checked with its file before any computation."""
    from eitskin.simulator.view.render import require_picture
    from eitskin.simulator.view.scene_pictures import Colour

    if view is not None:
        require_picture(view)
    for option, given in (("--colour", colour), ("--drive", drive)):
        if given is not None and view is None:
            raise ConfigurationError(f"{option} says what to draw; name the picture with --view")
    what = one_of("--colour", colour or "conductance", Colour)
    if drive is None:
        return what, None
    if what != "current":
        raise ConfigurationError(f"--drive is for --colour current, got --colour {what}")
    return what, electrode_pair(drive, electrodes)


def _title(name: str, scene: "Scene") -> str:
    """Title of a scene: name, deformation and number of touches."""
    parts = [f"bent by {scene.bend.angle_deg:g} deg"] if scene.bend.angle_deg else []
    parts += [f"rolled by {scene.roll.angle_deg:g} deg"] if scene.roll else []
    parts += [f"twisted by {scene.twist.angle_deg:g} deg"] if scene.twist else []
    count = len(scene.touches)
    parts += [f"{count} touch{'es' * (count > 1)}"] if count else []
    return f"{name}: {', '.join(parts) or 'flat, untouched'}"


def _relative_change(frame: "Frame", flat: "Frame") -> list[float | None]:
    """Relative change of resistance from the flat frame; None where that is zero but rounding."""
    import numpy as np

    before = flat.impedance.real
    rounding = 1e-9 * np.abs(before).max()
    return [
        float(now / then - 1.0) if abs(then) > rounding else None
        for now, then in zip(frame.impedance.real, before, strict=True)
    ]


def _as_data(frame: "Frame", flat: "Frame", seconds: float) -> dict[str, object]:
    return {
        "measurements": list(frame.protocol.labels),
        "independent": frame.protocol.rank,
        "impedance_real_ohm": frame.impedance.real.tolist(),
        "impedance_imag_ohm": frame.impedance.imag.tolist(),
        "status": frame.status.tolist(),
        "change_ohm": (frame.impedance - flat.impedance).real.tolist(),
        "relative_change": _relative_change(frame, flat),
        "seconds": seconds,
    }


def _as_table(frame: "Frame", flat: "Frame") -> Table:
    figures = ("R, ohm", "X, ohm", "change, ohm", "change, %")
    table = Table("measurement", *(Column(each, justify="right") for each in figures))
    for label, Z, before, part in zip(
        frame.protocol.labels,
        frame.impedance,
        flat.impedance,
        _relative_change(frame, flat),
        strict=True,
    ):
        percent = "" if part is None else f"{100 * part:+.3f}"
        change = f"{(Z - before).real:+.3f}"
        table.add_row(label, f"{Z.real:.3f}", f"{Z.imag:.3f}", change, percent)
    return table


def _touch_data(press: "PressedTouch") -> dict[str, object]:
    return {
        "x_m": press.touch.x,
        "y_m": press.touch.y,
        "force_N": press.force,
        "depth_m": press.depth,
        "contact_radius_m": press.contact_radius,
        "contact_area_m2": press.contact_area,
        "mean_pressure_Pa": press.mean_pressure,
        "peak_pressure_Pa": press.peak_pressure,
        "thinning": press.thinning,
        "edge_distance_m": press.edge_distance,
        "neighbour_distance_m": (
            press.neighbour_distance if math.isfinite(press.neighbour_distance) else None
        ),
        "signal_error": press.signal_error,
        "caution": press.caution,
    }


def _touch_table(presses: "tuple[PressedTouch, ...]") -> Table:
    units = ("force\nN", "depth\nmm", "contact\nmm2", "mean\nkPa", "peak\nkPa")
    figures = (*units, "gel thinner\nby, %", "to edge\nmm")
    table = Table("touch\nat, mm", *(Column(each, justify="right") for each in figures))
    for press in presses:
        table.add_row(
            f"{1e3 * press.touch.x:.1f}, {1e3 * press.touch.y:.1f}",
            f"{press.force:.2f}",
            f"{1e3 * press.depth:.3f}",
            f"{1e6 * press.contact_area:.1f}",
            f"{1e-3 * press.mean_pressure:.1f}",
            f"{1e-3 * press.peak_pressure:.1f}",
            f"{100 * press.thinning:.1f}",
            f"{1e3 * press.edge_distance:.1f}",
        )
    return table


def _cautions(presses: "tuple[PressedTouch, ...]") -> list[str]:
    return [
        f"caution: touch at {1e3 * press.touch.x:.1f}, {1e3 * press.touch.y:.1f} mm: "
        f"{press.caution}"
        for press in presses
        if press.caution
    ]


def on_support(scene: "Scene", support: str | None) -> "Scene":
    """Scene on the support of the option --support, where one is given.

    Raises ConfigurationError where the option names no support.
    """
    from eitskin.config import from_dict
    from eitskin.simulator.scene.scene import Scene

    if support is None:
        return scene
    given = from_dict(Scene, {"support": support}, "--support")
    return dataclasses.replace(scene, support=given.support)


def announce_unsolved(simulator: "Simulator", scene: "Scene", output: Output) -> None:
    """Note what has to be solved for a scene's touches first: dents, or presses in 3D."""
    from eitskin.simulator.deformation.press_table import press_problems
    from eitskin.simulator.deformation.solution_store import cache_folder, missing

    sensor = simulator.supported(scene), simulator.mechanics
    indenters = dict.fromkeys(touch.indenter for touch in scene.touches)
    unsolved = sum(bool(missing(press_problems(*sensor, i, simulator.grid))) for i in indenters)
    if unsolved:
        several = unsolved > 1
        output.note(
            f"solving the presses of {unsolved} indenter{'s' * several} that "
            f"{'are' if several else 'is'} new to this sensor, once: from ten seconds to a few "
            f"minutes each; kept in {cache_folder()}"
        )
    if simulator.solves_presses(scene):
        output.note(
            "solving the scene's touches in 3D, since no tables ship for them or the sensor is "
            "pressed in its bent state: half a minute to some minutes"
        )
