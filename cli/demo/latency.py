"""How long a pipeline takes for a frame, whole and by its stages."""

import dataclasses
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.frame import Frame
from eitskin.training.evaluation.metrics import percentiles
from eitskin.training.paper.method import PaperMethod
from eitskin.training.pipeline.pipeline import Pipeline

STAGES = {
    "classifier": "state",
    "bend_angle": "bend angle",
    "reconstruction": "reconstruction",
    "postprocessor": "touch map",
}
"""Attributes of the paper's method, and what each finds."""


@dataclass(frozen=True, slots=True, eq=False)
class Times:
    """Of some frames in a row.

    Attributes:
        whole: of `Pipeline.process` for each frame (n,) [ms].
        stages: by name, of each time that the stage was needed (k,) [ms]; empty for a method
            without stages.
    """

    whole: NDArray[np.float64]
    stages: dict[str, NDArray[np.float64]]

    def as_dict(self) -> dict[str, Any]:
        """Median and 99th percentile, as JSON takes them."""
        rows = {"whole frame": self.whole, **self.stages}
        return {
            name: dict(zip(("p50_ms", "p99_ms"), percentiles(list(values)), strict=True))
            | {"times": len(values)}
            for name, values in rows.items()
        }


class _Clocked:
    """A stage that notes how long its `apply` takes, and is the stage in all else."""

    def __init__(self, stage: Any) -> None:
        self._stage = stage
        self.seconds: list[float] = []

    def apply(self, *inputs: Any) -> Any:
        """What the stage makes of `inputs`."""
        start = time.perf_counter()
        output = self._stage.apply(*inputs)
        self.seconds.append(time.perf_counter() - start)
        return output

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stage, name)


def time_pipeline(pipeline: Pipeline, data: Dataset, most: int = 300) -> Times:
    """Time frames of the first specimen as a session, after its flat reference.

    The pipeline's own session is left alone. Raises DataError for a dataset without a protocol.
    """
    method, clocked = pipeline.method, {}
    if isinstance(method, PaperMethod):
        clocked = {name: _Clocked(getattr(method, name)) for name in STAGES}
        method = dataclasses.replace(method, **clocked)  # type: ignore[arg-type]
    session = dataclasses.replace(pipeline, method=method)
    mine = np.flatnonzero(data.specimen == data.specimen[0])[:most]
    frames = [_numbered(data.frame(int(row)), n + 1) for n, row in enumerate(mine)]
    flat = data.reference[data.specimen[0]].astype(np.complex128)
    session.process(dataclasses.replace(_numbered(frames[0], 0), impedance=flat))
    for stage in clocked.values():
        stage.seconds.clear()
    seconds = []
    for frame in frames:
        start = time.perf_counter()
        session.process(frame)
        seconds.append(time.perf_counter() - start)
    stages = {STAGES[name]: stage.seconds for name, stage in clocked.items() if stage.seconds}
    milliseconds = {name: 1e3 * np.array(each) for name, each in stages.items()}
    return Times(1e3 * np.array(seconds), milliseconds)


def _numbered(frame: Frame, number: int) -> Frame:
    """The frame as the `number`-th of one session."""
    return dataclasses.replace(frame, number=number, time=0.1 * number, session=0)
