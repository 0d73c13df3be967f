"""Dataset in memory: frames with their labels."""

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import require_count, require_seed
from eitskin.config import toml_table
from eitskin.datasets.store.frame_tensors import NAMES, FrameTensors
from eitskin.datasets.store.manifest import Names
from eitskin.datasets.store.schema import (
    FIELDS,
    FRAME_FIELDS,
    LIMITS,
    MAX_AVERAGED_FRAMES,
    MAX_TOUCHES,
    QUANTITIES,
    ColumnCollector,
    check_values,
    frame_bytes,
)
from eitskin.errors import ConfigurationError, DataError
from eitskin.extras import old_names
from eitskin.files import quote_value
from eitskin.frame import Frame, Status
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol

# Attributes that all parts of a dataset share.
ORIGIN: Final = ("protocol", "frequency", "source", "recipe", "seed", "design", "quantity")

_NO_VALUE: Any = ()
"""Default of the arrays: unknown values, and numbers that count."""


@old_names(untouched="values_before_touch")
@dataclass(frozen=True, slots=True, eq=False)
class Dataset:
    """Frames of one or several specimens; n frames, C channels, S specimens.

    Attributes:
        impedance: measured, (n, C) complex64 [ohm]; measured recordings may hold any quantity
            proportional to an impedance.
        touch_reference: untouched sensor at the same bend, with its own noise, (n, C)
            complex64 [ohm]; NaN where unknown.
        reference: flat, untouched sensor, (S, C) complex64 [ohm].
        specimen: row of `reference` for each frame, (n,) uint32.
        state: `State`, or `UNKNOWN_STATE`, (n,) uint8.
        bend_angle_deg: (n,) float32; NaN where unknown.
        touch_x, touch_y: position on the flat sensor, (n, 4) float32 [m]; NaN where absent.
        touch_force: (n, 4) float32 [N]; NaN where absent or unknown.
        touch_radius: touch radius of the indenter, (n, 4) float32 [m]; NaN where absent or unknown.
        touch_depth: travel of the indenter from first contact, (n, 4) float32 [m]; NaN where absent
            or unknown, and everywhere when omitted.
        clamp_span, clamp_offset: free length of the clamp that bends the sensor, and its axis below
            the mid-plane, (n,) float32 [m]; as the next two NaN where unknown, and when omitted.
        clamp_faces: number of the faces that its plates hold, (n,) float32.
        clamp_stiffness: shear modulus of the encapsulation over that of the layer, (n,) float32.
        support_gap: gap between the plates that carry the sensor, 0 on a base, (n,) float32 [m];
            NaN where unknown.
        time: since the episode's start, (n,) float64 [s].
        status: `eitskin.simulator.Status` bits, (n, C) uint8.
        episode: number of the episode, whose frames follow each other in time, (n,) uint32.
        number: number of each frame as counted by the board, (n,) uint32; a gap means lost frames.
        protocol: drive and sense pairs of the channels; None where unknown.
        frequency: frequency of the excitation [Hz].
        source: "simulated" or "measured".
        recipe: TOML text of the recipe; empty for recordings.
        seed: seed of everything random in the frames.
        design: nominal sensor; None where unknown.
        specimen_number: number of each specimen within the whole dataset, rising, (S,) uint32. A
            part of a dataset may hold few of its specimens. 0 to S - 1 when omitted.
        quantity: kind of the values: "impedance" [ohm] with sign and phase, "magnitude" of
            impedances [ohm], "voltage" [V]; empty where the recording does not say.
        names: names of specimens and sessions, as a recording gave them.

    Example:
        >>> import numpy as np
        >>> from eitskin.datasets import Dataset, State
        >>> data = Dataset.from_arrays(np.full((4, 28), 600.0), state=np.full(4, State.IDLE))
        >>> len(data), data.impedance.shape
        (4, (4, 28))
    """

    impedance: NDArray[np.complex64]
    reference: NDArray[np.complex64]
    touch_reference: NDArray[np.complex64] = _NO_VALUE
    specimen: NDArray[np.uint32] = _NO_VALUE
    state: NDArray[np.uint8] = _NO_VALUE
    bend_angle_deg: NDArray[np.float32] = _NO_VALUE
    touch_x: NDArray[np.float32] = _NO_VALUE
    touch_y: NDArray[np.float32] = _NO_VALUE
    touch_force: NDArray[np.float32] = _NO_VALUE
    touch_radius: NDArray[np.float32] = _NO_VALUE
    touch_depth: NDArray[np.float32] = _NO_VALUE
    clamp_span: NDArray[np.float32] = _NO_VALUE
    clamp_offset: NDArray[np.float32] = _NO_VALUE
    clamp_faces: NDArray[np.float32] = _NO_VALUE
    clamp_stiffness: NDArray[np.float32] = _NO_VALUE
    support_gap: NDArray[np.float32] = _NO_VALUE
    time: NDArray[np.float64] = _NO_VALUE
    status: NDArray[np.uint8] = _NO_VALUE
    episode: NDArray[np.uint32] = _NO_VALUE
    number: NDArray[np.uint32] = _NO_VALUE
    specimen_number: NDArray[np.uint32] = _NO_VALUE
    protocol: Protocol | None = None
    frequency: float = 40e3
    source: str = "measured"
    recipe: str = ""
    seed: int = 0
    design: SensorDesign | None = None
    quantity: str = ""
    names: Names = dataclasses.field(default_factory=Names)

    def __post_init__(self) -> None:
        """Convert the arrays to the format's types, and check shapes and values."""
        sizes = {"frame": len(self.impedance), "channel": np.shape(self.impedance)[-1]}
        sizes |= {"specimen": len(self.reference), "touch": MAX_TOUCHES}
        for axis in ("channel", "specimen"):
            if not 1 <= sizes[axis] <= LIMITS[axis]:
                raise DataError(f"expected 1 to {LIMITS[axis]} {axis}s, got {sizes[axis]}")
        counts = {"number": sizes["frame"], "specimen_number": sizes["specimen"]}
        for field in FIELDS:
            expected = tuple(sizes[axis] for axis in field.axes)
            values = getattr(self, field.name)
            if np.size(values) == 0:
                count = counts.get(field.name)
                values = np.full(expected, field.missing) if count is None else np.arange(count)
            values = np.ascontiguousarray(values, dtype=field.dtype)
            if values.shape != expected:
                raise DataError(
                    f"{field.name} must have shape {expected} ({', '.join(field.axes)}), "
                    f"got {values.shape}"
                )
            object.__setattr__(self, field.name, values)
        if self.source == "simulated" and not self.quantity:
            object.__setattr__(self, "quantity", "impedance")
        check_values(self.columns)
        if self.source not in ("simulated", "measured"):
            raise DataError(f"source must be 'simulated' or 'measured', got {self.source!r}")
        if self.quantity not in ("", *QUANTITIES):
            raise DataError(
                f"quantity must be {', '.join(QUANTITIES)} or empty, got {self.quantity!r}"
            )
        if self.protocol is not None and len(self.protocol) != self.channels:
            raise DataError(
                f"the protocol has {len(self.protocol)} measurements, but the frames have "
                f"{self.channels} channels; give the protocol they were measured with"
            )

    @classmethod
    def from_arrays(
        cls,
        impedance: ArrayLike,
        reference: ArrayLike | None = None,
        **known: Any,
    ) -> "Dataset":
        """Dataset of the given arrays, with the format's values for "unknown" elsewhere.

        Args:
            impedance: (n, C) [ohm].
            reference: (S, C) or (C,) [ohm]; the first frame when omitted.
            known: any other attributes of `Dataset`.

        Raises DataError for wrong shapes or values.
        """
        values = np.asarray(impedance)
        if values.ndim != 2 or 0 in values.shape:
            raise DataError(
                "impedance must be a table of frames by channels with at least one of each, got "
                f"shape {values.shape}"
            )
        first = values[0] if reference is None else reference
        return cls(impedance=values, reference=np.atleast_2d(np.asarray(first)), **known)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.impedance)

    @property
    def channels(self) -> int:
        """Number of measurements of a frame."""
        return int(self.impedance.shape[1])

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """All arrays by name, (n, ...) for each frame and (S, ...) for each specimen."""
        return {field.name: getattr(self, field.name) for field in FIELDS}

    @property
    def bytes_per_frame(self) -> int:
        """Size of one frame in memory."""
        return frame_bytes(self.channels, [field.name for field in FRAME_FIELDS])

    @property
    def reference_frames(self) -> int:
        """Number of frames averaged for each `touch_reference`, from the recipe."""
        return self._averaged_count("reference_frames")

    @property
    def touch_frames(self) -> int:
        """Number of frames averaged for each touched frame, from the recipe."""
        return self._averaged_count("touch_frames")

    def _averaged_count(self, key: str) -> int:
        """Number of averaged frames by one of the keys `AVERAGED` of the recipe."""
        stated = toml_table(self.recipe, "the recipe of the dataset").get(key, 1)
        if not (isinstance(stated, int) and 1 <= stated <= MAX_AVERAGED_FRAMES):
            raise DataError(
                f"the recipe of the dataset: {key} must be from 1 to {MAX_AVERAGED_FRAMES}, got "
                f"{quote_value(stated)}; generate the dataset again"
            )
        return stated

    @property
    def touch_count(self) -> NDArray[np.int64]:
        """Number of touches in each frame, (n,)."""
        count: NDArray[np.int64] = np.isfinite(self.touch_x).sum(axis=1)
        return count

    @property
    def has_touch_reference(self) -> NDArray[np.bool_]:
        """Whether the values before its touches are known of each frame, (n,)."""
        return np.asarray(np.isfinite(self.touch_reference).all(axis=1))

    @property
    def values_before_touch(self) -> NDArray[np.complex64]:
        """Values before the touches of each frame, or else of the flat sensor, (n, C) [ohm]."""
        has_reference, flat = self.has_touch_reference[:, None], self.reference[self.specimen]
        return np.where(has_reference, self.touch_reference, flat)

    @property
    def specimen_names(self) -> tuple[str, ...]:
        """Names of the specimens of these frames; the number of one that has no name."""
        numbers = self.specimen_number[np.unique(self.specimen)]
        return tuple(self.names.specimen(int(number)) for number in numbers)

    def read(self, *names: str) -> None:
        """Read columns that are not in memory yet, in one pass; those of a `StoredDataset` only."""

    def frame(self, index: int) -> Frame:
        """Frame `index` in the form of a board's frame; raises DataError without a protocol.

        Values with the status NOT_FINITE are NaN.
        """
        if self.protocol is None:
            raise DataError(
                "expected a recording with the electrodes of its channels, got none; import with "
                "--protocol, or use the arrays"
            )
        require_count("index", index, -len(self), len(self) - 1)
        lost = (self.status[index] & np.uint8(Status.NOT_FINITE)).astype(bool)
        return Frame(
            impedance=np.where(lost, np.nan, self.impedance[index].astype(np.complex128)),
            protocol=self.protocol,
            time=float(self.time[index]),
            number=int(self.number[index]),
            session=int(self.episode[index]),
            frequency=self.frequency,
            status=self.status[index],
        )

    def torch(self, *names: str) -> FrameTensors:
        """Frames for `torch.utils.data.DataLoader`: dictionaries of tensors by attributes' names.

        Items have all attributes where none is named. Raises ConfigurationError for unknown names,
        and ImportError without torch.
        """
        return FrameTensors(self, names or NAMES)

    def select(self, indices: ArrayLike | slice) -> "Dataset":
        """Frames at `indices` (integers, slice or mask) in that order, with all specimens."""
        chosen = frame_numbers(indices)
        if not isinstance(chosen, slice) and chosen.dtype.kind in "iu":
            for index in (chosen.min(initial=0), chosen.max(initial=0)):
                require_count("indices", int(index), -len(self), max(0, len(self) - 1))
        return dataclasses.replace(
            self, **{field.name: getattr(self, field.name)[chosen] for field in FRAME_FIELDS}
        )

    def split(
        self, fractions: Sequence[float], seed: int = 0, whole_touches: bool = True
    ) -> tuple[NDArray[np.int64], ...]:
        """Random disjoint numbers of frames, (n,) each, in proportions that sum to one.

        Whole specimens are distributed where every part gets at least one, so that a test part
        holds sensors unseen in training. Otherwise single frames are, those with touches at the
        same positions together, as they may be of one touch, where every part gets some.

        Args:
            fractions: fractions of the parts, in (0, 1], with sum one.
            seed: seed of the random order.
            whole_touches: whether such frames stay together.
        """
        shares = np.asarray(fractions, dtype=float)
        if shares.ndim != 1 or not (shares > 0).all() or abs(shares.sum() - 1.0) > 1e-9:
            raise ConfigurationError(
                f"fractions must be positive and sum to one, got {tuple(fractions)}"
            )
        require_seed(seed)
        rng = np.random.default_rng(seed)
        specimens = rng.permutation(np.unique(self.specimen))
        parts = _deal(specimens, shares)
        if all(len(part) for part in parts):
            return tuple(np.flatnonzero(np.isin(self.specimen, part)) for part in parts)
        group = self._touch_groups()
        touches = np.random.default_rng((seed, 1)).permutation(group.max(initial=-1) + 1)
        sizes = np.bincount(group[group >= 0], minlength=len(touches))[touches]
        parts = _deal(touches, shares, sizes)
        if not whole_touches or not all(len(part) for part in parts):
            return tuple(np.sort(part) for part in _deal(rng.permutation(len(self)), shares))
        # Other frames apart, so that every part gets its share of both.
        others = _deal(rng.permutation(np.flatnonzero(group < 0)), shares)
        return tuple(
            np.sort(np.concatenate([np.flatnonzero(np.isin(group, part)), rest]))
            for part, rest in zip(parts, others, strict=True)
        )

    def _touch_groups(self) -> NDArray[np.int64]:
        """Numbers, (n,), that frames with touches at the same positions share; -1 without."""
        touched = self.touch_count > 0
        group = np.full(len(self), -1)
        positions = np.concatenate([self.touch_x, self.touch_y], axis=1)[touched]
        same = np.unique(np.nan_to_num(positions, nan=-1.0), axis=0, return_inverse=True)[1]
        group[touched] = same.reshape(-1)
        return group

    def own_specimens(self) -> "Dataset":
        """The same frames, at least one, with only the specimens that occur in them."""
        rows = np.unique(self.specimen)
        if len(rows) == len(self.reference):
            return self
        return dataclasses.replace(
            self,
            reference=self.reference[rows],
            specimen_number=self.specimen_number[rows],
            specimen=np.searchsorted(rows, self.specimen).astype(np.uint32),
        )

    @classmethod
    def concatenate(cls, parts: Sequence["Dataset"]) -> "Dataset":
        """Dataset of all frames of `parts`; raises DataError for parts of different datasets."""
        return cls.collect(parts, sum(map(len, parts)))

    @classmethod
    def collect(cls, parts: Iterable["Dataset"], frames: int) -> "Dataset":
        """Dataset of all frames of `parts`, which are taken one at a time.

        Takes the memory of the result and of one part.

        Args:
            parts: parts of one dataset, at least one.
            frames: number of frames of all parts together.

        Raises DataError for parts of different datasets, or another number of frames.
        """
        remaining_parts = iter(parts)
        first = next(remaining_parts, None)
        if first is None:
            raise DataError("expected at least one part of a dataset, got none")
        collected = ColumnCollector(first.channels, frames, {field.name for field in FIELDS})
        end = 0
        for part in itertools.chain((first,), remaining_parts):
            require_same_origin(first, part)
            start, end = end, end + len(part)
            if end > frames:
                break
            collected.put(slice(start, end), part.columns)
        if end != frames:
            raise DataError(f"expected parts with {frames} frames in all, got {end}")
        return dataclasses.replace(first, **collected.whole())


def require_same_origin(first: Dataset, second: Dataset) -> None:
    """Raise DataError where two datasets cannot be parts of one."""
    if first.protocol is not None and second.protocol is not None:
        first.protocol.require_same(
            second.protocol,
            "one part of the dataset has",
            "another has",
            "join only parts of one protocol",
        )
    names = ("channels", *ORIGIN)
    different = [name for name in names if getattr(first, name) != getattr(second, name)]
    if different:
        raise DataError(
            f"the parts of a dataset must share its {', '.join(different)}; these were not made "
            "together: combine different datasets with eitskin dataset combine"
        )


def frame_numbers(indices: ArrayLike | slice) -> Any:
    """Slice or array that selects frames; numpy makes floats of an empty list."""
    chosen: Any = indices if isinstance(indices, slice) else np.asarray(indices)
    if np.size(chosen) and not isinstance(chosen, slice) and chosen.dtype.kind not in "biu":
        raise ConfigurationError("indices: expected whole numbers, a mask or a slice, got others")
    return chosen.astype(np.int64) if np.size(chosen) == 0 else chosen


def _deal(
    items: NDArray[Any], shares: NDArray[np.float64], sizes: NDArray[np.int64] | None = None
) -> list[NDArray[Any]]:
    """Consecutive parts of `items`, of one size or of `sizes`, in the proportions `shares`."""
    ends = np.cumsum(np.ones(len(items)) if sizes is None else sizes)
    before = ends - 0.5 * np.diff(ends, prepend=0.0)
    edges = np.searchsorted(before, np.cumsum([0.0, *shares]) * ends[-1:].sum())
    return [items[start:stop] for start, stop in itertools.pairwise(edges)]
