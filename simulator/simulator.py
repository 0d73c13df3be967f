"""From a scene to the frame that its sensor would give."""

from functools import cached_property, reduce

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry import ConfigurationError, Hinge, SensorDesign, Surface
from eitskin.geometry.bend import Fixture
from eitskin.geometry.deformation import Composed, Deformation, area_ratio, pulled_back
from eitskin.simulator.forward import ForwardModel
from eitskin.simulator.frame import Frame
from eitskin.simulator.instrument import WhiteNoise
from eitskin.simulator.protocol import Protocol
from eitskin.simulator.resolution import Discretisation, Resolution
from eitskin.simulator.scene import Scene
from eitskin.simulator.touch import Dents

Array = NDArray[np.float64]


class Simulator:
    """One sensor on one fixture, meshed once; `measure` gives the frame of any scene.

    Attributes:
        design: the sensor.
        fixture: what bends it.
        protocol: which pairs are measured.
        model: the forward model; `model.factorisations` counts the work done.
    """

    def __init__(
        self,
        design: SensorDesign,
        resolution: Resolution | Discretisation = "standard",
        fixture: Fixture | None = None,
        protocol: Protocol | None = None,
    ) -> None:
        """Mesh the sensor, with faces where the fixture clamps it.

        Args:
            design: the sensor.
            resolution: "fast", "standard" or "fine", or element order and grading.
            fixture: the default hinge when omitted.
            protocol: every pair of electrodes when omitted.
        """
        self.design = design
        self.fixture: Fixture = fixture or Hinge()
        self.protocol = protocol or Protocol.pairwise(len(design.electrodes))
        middle, half = design.outline.length / 2, self.fixture.bent_length / 2
        # Without a transition F jumps at the clamps: the mesh must have faces there.
        breaks = () if self.fixture.transition else (middle - half, middle + half)
        self.model = ForwardModel(design, resolution, breaks=breaks)
        self._last: tuple[Scene, NDArray[np.inexact]] | None = None

    @cached_property
    def full_scale(self) -> float:
        """Largest resistance of the flat, untouched sensor [ohm]."""
        return float(np.abs(self.protocol.measure(self.model.impedance())).max())

    def deformation(self, scene: Scene) -> Deformation | None:
        """How the scene deforms the sensor, touch first, then bend; None where it does not."""
        outline = self.design.outline
        if isinstance(outline, Surface):
            if scene == Scene():
                return None
            raise ConfigurationError(
                "bending and touches need a rectangle, disc or polygon as outline, not a surface"
            )
        for touch in scene.touches:
            if not outline.contains(np.array([touch.x, touch.y])):
                raise ConfigurationError(
                    f"a touch must lie on the {type(outline).__name__.lower()} of "
                    f"{outline.length:g} x {outline.width:g} m, got ({touch.x:g}, {touch.y:g}) m; "
                    "are the units metres?"
                )
        parts: list[Deformation] = []
        if scene.touches:
            parts.append(Dents(scene.touches))
        if scene.roll is not None:
            parts.append(scene.roll.deformation(self.design))
        if scene.bend.angle_deg:
            parts.append(self.fixture.flexure(self.design, scene.bend))
        if scene.twist is not None:
            parts.append(scene.twist.deformation(self.design))
        return reduce(Composed, parts) if parts else None

    def deformed(self, deformation: Deformation) -> Frame:
        """The frame of the sensor under any deformation, such as `Displaced` by a function."""
        return Frame(self._measured(self._deformed(deformation)), self.protocol)

    def measure(
        self,
        scene: Scene,
        instrument: WhiteNoise | None = None,
        rng: np.random.Generator | None = None,
    ) -> Frame:
        """The frame of `scene`, noise-free unless an `instrument` is given.

        The scene measured last is kept: asked for again, it costs only new noise.

        Raises:
            ConfigurationError: for a touch off the layer, an angle that cannot be reached, or an
                instrument without a random generator.
        """
        if self._last is None or self._last[0] != scene:
            self._last = (scene, self._impedance(scene))
        impedance = self._measured(self._last[1])
        if instrument is not None:
            if rng is None:
                raise ConfigurationError(
                    "an instrument needs rng=numpy.random.default_rng(seed) for its noise"
                )
            impedance = instrument.apply(impedance, self.full_scale, rng)
        return Frame(impedance=impedance, protocol=self.protocol)

    def _impedance(self, scene: Scene) -> NDArray[np.inexact]:
        deformation = self.deformation(scene)
        return self.model.impedance() if deformation is None else self._deformed(deformation)

    def _deformed(self, deformation: Deformation) -> NDArray[np.inexact]:
        sigma = self.design.conductivity_at
        return self.model.impedance(
            conductivity=lambda x: sigma(x)[..., None, None] * pulled_back(deformation.gradient(x)),
            area_ratio=lambda x, normal: area_ratio(deformation.gradient(x), normal),
        )

    def _measured(self, impedance: NDArray[np.inexact]) -> NDArray[np.complex128]:
        measured: NDArray[np.complex128] = self.protocol.measure(impedance).astype(np.complex128)
        return measured
