"""Virtual board: simulated measurements behind a line in memory, or a pseudo-terminal.

The host speaks with it as with a real board's port, so both share the host's code.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Fixture
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.hardware.boards.serial_board import SerialBoard
from eitskin.hardware.virtual import stage as scenes
from eitskin.hardware.virtual.fault import Fault
from eitskin.hardware.virtual.fault_table import read_faults
from eitskin.hardware.virtual.memory_line import MemoryLine, PseudoTerminal
from eitskin.hardware.virtual.virtual_firmware import VirtualFirmware
from eitskin.protocol import Protocol
from eitskin.simulator.deformation.sensor_grid import read_fixed
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Simulator

SPEEDS = ("real", "max")
MAX_PERIOD = 3600.0  # s


def virtual_firmware(
    *,
    resolution: str = "fast",
    scene: str | Path | Scene | scenes.SceneSource | None = None,
    seed: int = 0,
    snr_db: float = 75.0,
    instrument: Instrument | str | None = None,
    faults: str | Sequence[Fault] = (),
    simulator: scenes.SceneSolver | None = None,
    sensor: str | Path | SensorDesign | None = None,
    protocol: str | Protocol | None = None,
    fixture: str | Path | Fixture | None = None,
    mechanics: str | Path | Mechanics | None = None,
    period: float | None = None,
) -> VirtualFirmware:
    """Firmware of a virtual board that has not booted yet.

    Args:
        resolution: resolution of the simulator: "coarse", "fast", "standard" or "fine".
        scene: a scene, a `Script`, a function from frame number to scene, or the path of a TOML
            file that holds one of the first two; the flat untouched sensor when omitted.
        seed: seed of the instrument.
        snr_db: full scale over noise [dB]; infinity for no noise.
        instrument: instrument, its name or TOML file; white noise of `snr_db` when omitted.
        faults: faults as text, "name@frame:index,...", or as `Fault`s.
        simulator: simulator of the sensor; one of `sensor` when omitted.
        sensor: a design, or the path of its TOML file; the reference sensor when omitted.
        protocol: measurements of a frame, or their name or CSV file as for `Protocol.from_name`;
            all pairs of electrodes when omitted.
        fixture: device that bends the sensor, or its TOML file; the default clamp when omitted.
        mechanics: materials, or the path of their TOML file; gel in Ecoflex when omitted.
        period: time from frame to frame [s]; the AD5940's when omitted.

    Raises ConfigurationError for an option out of range.
    """
    if period is not None and not 1e-6 <= period <= MAX_PERIOD:
        raise ConfigurationError(
            f"period must be from 1e-06 to {MAX_PERIOD:g} s, as the wire can say it, got {period}"
        )
    arguments = (sensor, protocol, fixture, mechanics)
    if simulator is None:
        simulator = _simulator(resolution, *arguments)
    elif any(each is not None for each in arguments):
        raise ConfigurationError(
            "a simulator has its own sensor, protocol, fixture and mechanics; give the simulator "
            "or those"
        )
    if isinstance(instrument, str):
        instrument = Instrument.from_name(instrument)
    elif instrument is None and np.isfinite(snr_db):
        instrument = Instrument(snr_db)
    simulated = scenes.SimulatedSensor(simulator, instrument, seed, period)
    chosen = read_faults(faults) if isinstance(faults, str) else faults
    if isinstance(scene, str | Path):
        scene = scenes.Script.from_toml(scene)
    elif isinstance(scene, Scene):
        scene = scenes.Script((scenes.Step(scene),))
    stage = scenes.Stage(simulated.solve, scene, chosen)
    return VirtualFirmware(stage, simulated.protocol, simulated.measure, period)


def virtual_terminal(
    *, speed: str = "real", link: str | Path | None = None, **options: Any
) -> PseudoTerminal:
    """Pseudo-terminal of a virtual board, not yet served.

    Args:
        speed: "real", paced as the AD5940 is, or "max", as fast as it is read.
        link: path of a symbolic link to the terminal, kept over a pulled and replugged cable.
        options: arguments of `virtual_firmware`.

    Raises ConfigurationError for an option out of range.

    Example:
        >>> from eitskin.hardware import virtual_terminal
        >>> terminal = virtual_terminal(resolution="coarse")  # doctest: +SKIP
    """
    terminal = PseudoTerminal(_virtual_line(speed, options), link)
    terminal.firmware.stage.changed = terminal.wake
    return terminal


class VirtualBoard(SerialBoard):
    """Board of this process; closing the board closes its line.

    Attributes:
        stage: scene and faults, which may be changed while the board runs.

    Example:
        >>> from eitskin.hardware import open_virtual
        >>> with open_virtual(speed="max", resolution="coarse") as board:
        ...     next(iter(board.frames())).impedance.shape
        (28,)
    """

    stage: scenes.Stage

    def __init__(
        self,
        line: MemoryLine | PseudoTerminal,
        uri: str = "virtual:",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start the board at the other end of `line` and connect to it.

        The clock is that by which silence is measured [s].

        Raises DeviceError where the board does not answer as expected, because of its faults.
        """
        self._line, self.stage = line, line.firmware.stage
        line.start()
        try:
            super().__init__(lambda: line.connect(uri), uri, clock)
        except BaseException:
            line.close()
            raise

    def close(self) -> None:
        try:
            super().close()
        finally:
            self._line.close()


def open_virtual(
    uri: str = "virtual:", *, speed: str = "real", link: str | Path | None = None, **options: Any
) -> VirtualBoard:
    """Open a virtual board; the options are `virtual_terminal`'s.

    It has no terminal unless a link to one is asked for. At speed "max" each frame is then measured
    when it is read, and the same requests give the same frames on any machine.

    Example:
        >>> from eitskin.hardware import open_virtual
        >>> with open_virtual(speed="max", resolution="coarse", seed=1) as board:
        ...     next(iter(board.frames())).number
        0
    """
    if link is not None:
        return VirtualBoard(virtual_terminal(speed=speed, link=link, **options), uri)
    line = _virtual_line(speed, options)
    return VirtualBoard(line, uri, line.now)


def _virtual_line(speed: str, options: Mapping[str, Any]) -> MemoryLine:
    """Line to a virtual board, paced or as fast as it is read."""
    if speed not in SPEEDS:
        raise ConfigurationError(f"speed must be one of {', '.join(SPEEDS)}, got {speed!r}")
    firmware = virtual_firmware(**options)
    return MemoryLine(firmware, firmware.info.period if speed == "real" else 0.0)


def open_virtual_uri(path: str, uri: str, **options: Any) -> VirtualBoard:
    """Open the virtual board of a URI, which has no path."""
    if path:
        meant = path if "=" in path else f"scene={path}"
        raise ConfigurationError(
            f"virtual: takes options and no path, got {uri!r}; write virtual:?{meant}"
        )
    return open_virtual(uri, **options)


def _simulator(
    resolution: str,
    sensor: str | Path | SensorDesign | None,
    protocol: str | Protocol | None,
    fixture: str | Path | Fixture | None,
    mechanics: str | Path | Mechanics | None,
) -> Simulator:
    """Simulator of objects or of files that describe them."""
    if resolution not in get_args(Resolution):
        choices = ", ".join(get_args(Resolution))
        raise ConfigurationError(f"resolution must be one of {choices}, got {resolution!r}")
    design = SensorDesign.from_toml(sensor) if isinstance(sensor, str | Path) else sensor
    design = design or SensorDesign.reference()
    if isinstance(protocol, str):
        protocol = Protocol.from_name(protocol, len(design.electrodes))
    paths = [Path(each) if isinstance(each, str | Path) else None for each in (fixture, mechanics)]
    fixed = read_fixed(*paths)
    return Simulator(
        design,
        cast("Resolution", resolution),
        fixed[0] if isinstance(fixture, str | Path) else fixture,
        protocol,
        fixed[1] if isinstance(mechanics, str | Path) else mechanics,
        grid=fixed[2],
    )
