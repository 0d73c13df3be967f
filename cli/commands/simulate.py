"""`eitskin simulate`, `mesh` and `virtual-board`: a scene, a mesh, a simulated sensor's board."""

import dataclasses
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Group, RenderableType
from rich.table import Column, Table

from eitskin import geometry, hardware, simulator
from eitskin.cli import options
from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    from eitskin.geometry.meshing.mesh_design import CellKind
    from eitskin.simulator.scene.scene import PressedTouch


@options.with_output
def command(
    scene: options.SceneFile,
    *,
    sensor: options.SensorOptions,
    resolution: options.Detail = "standard",
    noise: Annotated[
        float | None, typer.Option(help="Add white noise this many dB below full scale.")
    ] = None,
    instrument: Annotated[
        str | None,
        typer.Option(help="Board that measures: ideal, ad5940, or an instrument file."),
    ] = None,
    support: Annotated[
        str | None,
        typer.Option(help="Support, rigid, plates or free, instead of the scene's."),
    ] = None,
    frequency: Annotated[
        list[float] | None,
        typer.Option(help="Frequency of the excitation [Hz]; give several for a spectrum."),
    ] = None,
    view: Annotated[Path | None, typer.Option(help="Draw the scene into this PNG file.")] = None,
    color: Annotated[
        Literal["conductance", "strain", "current"] | None,
        typer.Option(help="Quantity that colours the image."),
    ] = None,
    drive: Annotated[
        str | None,
        typer.Option(
            metavar="A-B",
            help="Current from A to B; the pair with the largest change if omitted.",
        ),
    ] = None,
    seed: int = 0,
    output: options.Output,
) -> None:
    """Simulate one scene: impedances, and depth and pressure of its touches."""
    import numpy as np

    what = on_support(simulator.Scene.from_toml(scene), support)
    board = _instrument(noise, instrument)
    design = options.read_design(sensor.sensor)
    pair = _drive(view, color, drive, len(design.electrodes))
    sim = sensor.simulator(resolution, design)
    sim.check_scene(what)  # before its presses are solved, which takes minutes
    spectrum: list[dict[str, Any]] = []
    for hertz in frequency or [40e3]:
        rng = np.random.default_rng(seed)
        flat = sim.measure(simulator.Scene(), _noise_free(board), rng, hertz)
        if not spectrum:
            announce_unsolved(sim, what, output)
        start = time.perf_counter()
        frame = sim.measure(what, board, np.random.default_rng(seed), hertz)
        spectrum.append(_as_data(frame, flat, time.perf_counter() - start))
    cells, seconds = len(sim.model.mesh.cells), sum(data["seconds"] for data in spectrum)
    output.detail(f"{sim.model.solver.name}, {cells} cells, {seconds:.3f} s")
    touches = [_touch_data(press) for press in sim.presses(what)]
    tables = [_as_table(data, len(spectrum) > 1) for data in spectrum]
    data = spectrum[0] if len(spectrum) == 1 else {"spectrum": spectrum}
    output.result(data | {"touches": touches}, Group(*tables, *_touch_tables(touches)))
    if view is not None:
        from eitskin.simulator.view.scene_pictures import draw_scenes

        draw_scenes(sim, [(_title(scene.stem, what), what)], view, color or "conductance", pair)
        output.note(f"picture: {view}")


def _instrument(noise: float | None, name: str | None) -> "simulator.Instrument | None":
    """Instrument model: white noise, a named board, that board with other noise, or none."""
    if name is None:
        return None if noise is None else simulator.Instrument(noise)
    board = simulator.Instrument.from_name(name)
    return board if noise is None else dataclasses.replace(board, snr_db=noise)


def _noise_free(board: "simulator.Instrument | None") -> "simulator.Instrument | None":
    """Circuit and reading of a board, by which the flat sensor's values are those of its frames."""
    if board is None or board.meter is None:
        return None
    return simulator.Instrument(snr_db=0.0, meter=board.meter)


def _drive(
    view: Path | None, color: str | None, drive: str | None, electrodes: int
) -> tuple[int, int] | None:
    """Drive pair of the picture, checked with its file before any computation."""
    from eitskin.simulator.view.drawing import require_picture

    if view is not None:
        require_picture(view)
    for option, option_value in (("--color", color), ("--drive", drive)):
        if option_value is not None and view is None:
            raise ConfigurationError(f"{option} says what to draw; name the picture with --view")
    if drive is None:
        return None
    if color != "current":
        raise ConfigurationError(f"--drive is for --color current, got --color {color}")
    return options.electrode_pair(drive, electrodes)


def _title(name: str, scene: "simulator.Scene") -> str:
    """Title of a scene: name, deformation and number of touches."""
    parts = [f"bent by {scene.bend.angle_deg:g} deg"] if scene.bend.angle_deg else []
    parts += [f"rolled by {scene.roll.angle_deg:g} deg"] if scene.roll else []
    parts += [f"twisted by {scene.twist.angle_deg:g} deg"] if scene.twist else []
    count = len(scene.touches)
    parts += [f"{count} touch{'es' * (count > 1)}"] if count else []
    return f"{name}: {', '.join(parts) or 'flat, untouched'}"


def _relative_change(frame: "simulator.Frame", flat: "simulator.Frame") -> list[float | None]:
    """Relative change of resistance from the flat frame; None where that is zero but rounding."""
    import numpy as np

    before = flat.impedance.real
    rounding = 1e-9 * np.abs(before).max()
    return [
        float(now / then - 1.0) if abs(then) > rounding else None
        for now, then in zip(frame.impedance.real, before, strict=True)
    ]


def _as_data(frame: "simulator.Frame", flat: "simulator.Frame", seconds: float) -> dict[str, Any]:
    return {
        "frequency_Hz": frame.frequency,
        "measurements": list(frame.protocol.labels),
        "independent": frame.protocol.rank,
        "impedance_real_ohm": frame.impedance.real.tolist(),
        "impedance_imag_ohm": frame.impedance.imag.tolist(),
        "status": frame.status.tolist(),
        "change_ohm": (frame.impedance - flat.impedance).real.tolist(),
        "relative_change": _relative_change(frame, flat),
        "seconds": seconds,
    }


def _as_table(data: dict[str, Any], with_frequency: bool) -> Table:
    """Table of `_as_data`, its frequency in the heading of the measurements if wanted."""
    heading = f"{data['frequency_Hz']:g} Hz" if with_frequency else "measurement"
    figures = ("R, ohm", "X, ohm", "change, ohm", "change, %")
    headings = [Column(figure, justify="right") for figure in figures]
    names = "measurements", "impedance_real_ohm", "impedance_imag_ohm", "change_ohm"
    columns = [*(data[name] for name in names), data["relative_change"]]
    return options.make_table(
        (heading, *headings),
        (
            (label, f"{R:.3f}", f"{X:.3f}", f"{change:+.3f}", _percent(part))
            for label, R, X, change, part in zip(*columns, strict=True)
        ),
    )


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:+.3f}"


_TOUCH_COLUMNS = (
    ("force\nN", "force_N", 1.0, ".2f"),
    ("depth\nmm", "depth_m", 1e3, ".3f"),
    ("contact\nmm2", "contact_area_m2", 1e6, ".1f"),
    ("mean\nkPa", "mean_pressure_Pa", 1e-3, ".1f"),
    ("peak\nkPa", "peak_pressure_Pa", 1e-3, ".1f"),
    ("gel thinner\nby, %", "thinning", 1e2, ".1f"),
    ("to edge\nmm", "edge_distance_m", 1e3, ".1f"),
)
"""Columns of the table of touches: heading, name in `_touch_data`, factor and form."""


def _touch_data(press: "PressedTouch") -> dict[str, Any]:
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
        "neighbour_distance_m": press.neighbour_distance,
        "signal_error": press.signal_error,
        "caution": press.caution,
    }


def _touch_tables(touches: list[dict[str, Any]]) -> Iterator[RenderableType]:
    """Table of touches, and their cautions; nothing without touches."""
    places = [f"{1e3 * touch['x_m']:.1f}, {1e3 * touch['y_m']:.1f}" for touch in touches]
    headings = (Column(heading, justify="right") for heading, *_ in _TOUCH_COLUMNS)
    rows = (
        (place, *(format(factor * touch[name], form) for _, name, factor, form in _TOUCH_COLUMNS))
        for place, touch in zip(places, touches, strict=True)
    )
    if touches:
        yield options.make_table(("touch\nat, mm", *headings), rows)
    for place, touch in zip(places, touches, strict=True):
        if touch["caution"]:
            yield f"caution: touch at {place} mm: {touch['caution']}"


def on_support(scene: "simulator.Scene", support: str | None) -> "simulator.Scene":
    """Scene on the support of the option --support, where one is given.

    Raises ConfigurationError where the option names no support.
    """
    from eitskin.config import from_dict

    if support is None:
        return scene
    support_scene = from_dict(simulator.Scene, {"support": support}, "--support")
    return dataclasses.replace(scene, support=support_scene.support)


def announce_unsolved(
    sim: "simulator.Simulator", scene: "simulator.Scene", output: options.Output
) -> None:
    """Note what has to be solved for a scene's touches first: dents, or presses in 3D."""
    from eitskin.simulator.deformation.press_table import press_problems
    from eitskin.simulator.deformation.solution_store import cache_folder, missing

    sensor = sim.design_on_support(scene), sim.mechanics
    indenters = dict.fromkeys(touch.indenter for touch in scene.touches)
    unsolved = sum(bool(missing(press_problems(*sensor, i, sim.grid))) for i in indenters)
    if unsolved:
        several = unsolved > 1
        output.note(
            f"solving the touches of {unsolved} indenter{'s' * several} that "
            f"{'are' if several else 'is'} new to this sensor, once: from ten seconds to a few "
            f"minutes each; kept in {cache_folder()}"
        )
    if sim.solves_presses(scene):
        output.note(
            "solving the scene's touches in 3D, since no tables ship for them or they are beyond "
            "these: half a minute to some minutes, but for footprints that were solved before"
        )


@options.with_output
def mesh(
    *,
    sensor: options.SensorFile = None,
    resolution: options.Detail = "standard",
    cells: Annotated[
        Literal["hexahedra", "prisms", "tetrahedra"] | None,
        typer.Option(help="Kind of cells; what suits the outline if omitted."),
    ] = None,
    view: Annotated[Path | None, typer.Option(help="Draw the mesh into this PNG file.")] = None,
    drive: Annotated[
        str | None,
        typer.Option(metavar="A-B", help="With --view: draw the current from A to B."),
    ] = None,
    output: options.Output,
) -> None:
    """Mesh a sensor: number and quality of its cells, and a picture."""
    from eitskin.simulator.electrical.resolution import discretisation, suited_cells
    from eitskin.simulator.electrical.stored_mesh import stored_mesh
    from eitskin.simulator.view.drawing import require_picture

    design = options.read_design(sensor)
    kind = cells or suited_cells(resolution, design)
    pair = None if drive is None else options.electrode_pair(drive, len(design.electrodes))
    if pair is not None and view is None:
        raise ConfigurationError("--drive says what to draw; name the picture with --view")
    if view is not None:
        require_picture(view)
    start = time.perf_counter()
    _, grading = discretisation(resolution, design, kind)
    new_mesh = stored_mesh(design, grading, kind)
    data = _mesh_data(design, new_mesh, kind, time.perf_counter() - start)
    output.result(
        data,
        options.make_table(
            ("mesh", Column("", justify="right")), _mesh_rows(data), show_header=False
        ),
    )
    if view is not None:
        from eitskin.simulator.view.scene_pictures import draw_drive, draw_mesh, model_for_pictures

        if pair is None:
            draw_mesh(new_mesh, view)
        else:
            draw_drive(model_for_pictures(design, kind), pair, view, new_mesh)
        output.note(f"picture: {view}")


def _mesh_data(
    design: "geometry.SensorDesign", mesh: "geometry.Mesh", kind: "CellKind", seconds: float
) -> dict[str, Any]:
    """Numbers of the mesh as plain data."""
    import numpy as np

    from eitskin.geometry.meshing.mesh import quality

    areas = np.array([patch.area for patch in design.patches()])
    meshed = np.bincount(mesh.contacts.electrode, mesh.contacts.areas, len(areas))
    return {
        "kind": kind,
        **dataclasses.asdict(quality(mesh)),
        "electrodes": len(areas),
        "electrode_area_error": float(np.abs(meshed / areas - 1.0).max()),
        "seconds": seconds,
    }


def _mesh_rows(data: dict[str, Any]) -> tuple[tuple[str, str], ...]:
    """Cells of the table of `_mesh_data`."""
    least, most = data["smallest_angle"], data["largest_angle"]
    return (
        ("cells", f"{data['cells']} {data['kind']}"),
        ("points", f"{data['points']}"),
        ("volume", f"{1e6 * data['volume']:.4g} cm3"),
        ("least scaled Jacobian, 1 is best", f"{data['scaled_jacobian']:.3g}"),
        ("longest to shortest edge, worst", f"{data['aspect_ratio']:.3g}"),
        ("longest to shortest edge, median", f"{data['median_aspect_ratio']:.3g}"),
        (
            "angles between faces",
            f"{least:.1f} to {most:.1f} deg",
        ),
        ("electrodes", f"{data['electrodes']}"),
        ("largest error of an electrode's area", f"{data['electrode_area_error']:.1e}"),
        ("time", f"{data['seconds']:.2f} s"),
    )


Faults = Annotated[
    str,
    typer.Option(help="Faults to inject, name@frame:index,...; --list-faults lists their names."),
]


@options.with_output
def virtual_board(
    *,
    scene: Annotated[
        Path | None, typer.Option(help="Scene or script (TOML); flat and untouched when omitted.")
    ] = None,
    sensor: options.SensorFile = None,
    protocol: options.Pairs = "pairwise",
    fixture: options.FixtureFile = None,
    mechanics: options.MechanicsFile = None,
    resolution: options.Detail = "fast",
    speed: Annotated[
        Literal["real", "max"],
        typer.Option(help="Pace of the AD5940, or a frame whenever one is read."),
    ] = "real",
    instrument: Annotated[
        str | None,
        typer.Option(help="Board: ideal, ad5940, or an instrument file; white noise when omitted."),
    ] = None,
    period: Annotated[
        float | None,
        typer.Option(min=1e-4, help="Time from frame to frame, s; the AD5940's when omitted."),
    ] = None,
    faults: Faults = "",
    link: Annotated[
        Path | None,
        typer.Option(help="A path that leads to the board, also after it was replugged."),
    ] = None,
    list_faults: Annotated[
        bool, typer.Option("--list-faults", help="List all faults and exit.")
    ] = False,
    seed: int = 0,
    output: options.Output,
) -> None:
    """Serve a virtual board on a pseudo-terminal until Ctrl-C; hosts can come and go."""
    if list_faults:
        from eitskin.hardware.virtual.fault_table import FAULTS

        meanings = {name: kind.meaning for name, kind in FAULTS.items()}
        output.result(meanings, options.make_table(("fault", "what it does"), meanings.items()))
        return
    output.detail(f"meshing at resolution {resolution}, computing the scenes")
    terminal = hardware.virtual_terminal(
        speed=speed,
        resolution=resolution,
        scene=scene,
        sensor=sensor,
        protocol=protocol,
        fixture=fixture,
        mechanics=mechanics,
        seed=seed,
        instrument=instrument,
        period=period,
        faults=faults,
        link=link,
    )
    uri = f"serial:{link or terminal.path}"
    output.result({"uri": uri}, uri)
    output.note(f"serving until Ctrl-C; open it with eitskin live MODEL --board {uri}", whole=True)
    # Started again it must not pass for the same board: hosts keep references for each boot.
    terminal.firmware.set_boot_count(int(time.time()))
    with options.ended_by_signals(), closing(terminal):
        terminal.serve()
