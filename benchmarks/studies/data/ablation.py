"""Ablation of the joint method: errors and time per frame without each of its parts.

    python -m eitskin.benchmarks.studies.data.ablation DATASET [--pipeline NAME] [--frames 400]

DATASET holds touched frames, such as `seed-0/unseen-touch` in the folder of `eitskin bench paper`.
Prints three tables in Markdown: errors and times without each part, the time of each stage, and
the time of a frame by its number of touches, the least of some runs; times are of the processor,
which other programs on the machine lengthen only by what they take of its caches.
"""

import argparse
import dataclasses
import time
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import open_dataset
from eitskin.datasets.store.touch_map import touch_maps
from eitskin.errors import ConfigurationError
from eitskin.provenance import Provenance
from eitskin.training.evaluation import matching, metrics
from eitskin.training.joint.method import JointMethod
from eitskin.training.joint.proposal_model import network_inputs
from eitskin.training.method.observations import Observations
from eitskin.training.pipeline.pipeline import Pipeline

REPEATS = 3

Array = NDArray[np.float64]
Places = Callable[[Observations], Array]
"""Places (k, 2) [m] of the touches in one frame."""


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", help="of touched frames")
    parser.add_argument("--pipeline", default="reference.eitmodel")
    parser.add_argument("--frames", type=int, default=400, help="at most")
    arguments = parser.parse_args()
    method = Pipeline.load(arguments.pipeline).method
    if not isinstance(method, JointMethod):
        raise ConfigurationError(f"expected a joint pipeline, got one of method '{method.KIND}'")
    data = open_dataset(arguments.dataset)
    data = data.select(np.flatnonzero(data.touch_count > 0)[: arguments.frames])
    print(f"{len(data)} frames of {arguments.dataset}; {Provenance.now(data.seed)}\n")
    print("| | mean error, mm | found, % | false, % | median ms | p99 ms |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, places in variants(method):
        print(
            f"| {name} | " + " | ".join(f"{value:.2f}" for value in measured(places, data)) + " |"
        )
    print("\n## stages\n\n| stage | median ms | p99 ms |\n| --- | --- | --- |")
    for name, seconds in stages(method, data).items():
        p50, p99 = metrics.percentiles([1e3 * value for value in seconds])
        print(f"| {name} | {p50:.2f} | {p99:.2f} |")
    print("\n## touches\n\n| touches | frames | median ms | p99 ms |\n| --- | --- | --- | --- |")
    for count in np.unique(data.touch_count).tolist():
        some = data.select(np.flatnonzero(data.touch_count == count))
        p50, p99 = metrics.percentiles([1e3 * value for value in least_seconds(method, some)])
        print(f"| {count} | {len(some)} | {p50:.2f} | {p99:.2f} |")


def variants(method: JointMethod) -> Iterator[tuple[str, Places]]:
    """Variants: the whole method, and the method without one part each."""
    silent = dataclasses.replace(
        method.proposals, biases=(*method.proposals.biases[:-1], method.proposals.biases[-1] - 50.0)
    )
    features = dataclasses.replace(
        method.features, directions=np.zeros_like(method.features.directions)
    )
    certain = dataclasses.replace(
        method.response, latent_output=np.zeros_like(method.response.latent_output)
    )
    bend = dataclasses.replace(
        method.bend_prior, covariance=1e-12 * np.eye(len(method.bend_prior.covariance))
    )
    yield "all of it", fitted(method)
    yield (
        "no network: places from the search alone",
        fitted(dataclasses.replace(method, proposals=silent)),
    )
    yield "no fit: places from the network alone", proposed(method)
    yield "no features of the specimen", fitted(dataclasses.replace(method, features=features))
    yield (
        "no hidden differences of specimens",
        fitted(dataclasses.replace(method, response=certain)),
    )
    yield "bend curve taken for certain", fitted(dataclasses.replace(method, bend_prior=bend))


def fitted(method: JointMethod) -> Places:
    """Touches found by the method."""
    return lambda frame: method.predict(frame).touches[0].place


def proposed(method: JointMethod) -> Places:
    """Touches proposed by the network, without the fit."""

    def places(frame: Observations) -> Array:
        change = np.log1p(frame.dynamic[0])
        features = method.features.apply(frame.flat[0])
        inputs = network_inputs(
            method.combinations.of(change),
            np.sqrt(2.0) * method.combinations.unit,
            0.0,
            features,
        )
        return method.proposals.places(inputs, method.touch_prior.separation)

    return places


def measured(places: Places, data: Dataset) -> tuple[float, float, float, float, float]:
    """Mean error [mm], found and false [%], median and p99 of the time per frame [ms]."""
    observations = Observations.of(data)
    pairs, seconds = [], []
    for i in range(len(data)):
        frame = observations[i : i + 1]
        places(frame)  # what is kept for a specimen and an angle is made here
        start = time.process_time()
        found = places(frame)
        seconds.append(time.process_time() - start)
        true = np.stack([data.touch_x[i], data.touch_y[i]], axis=1)
        pairs.append((true[np.isfinite(true[:, 0])], found))
    score = matching.localisation(pairs)
    p50, p99 = metrics.percentiles(seconds)
    error = 1e3 * float(np.mean(score.errors)) if score.errors else float("nan")
    share = 100.0 / score.true
    return error, share * len(score.errors), share * score.false, 1e3 * p50, 1e3 * p99


def least_seconds(method: JointMethod, data: Dataset) -> list[float]:
    """Least time of each frame among `REPEATS` runs."""
    observations = Observations.of(data)
    runs = []
    for _ in range(REPEATS):
        seconds = []
        for i in range(len(data)):
            frame = observations[i : i + 1]
            start = time.process_time()
            method.predict(frame)
            seconds.append(time.process_time() - start)
        runs.append(seconds)
    return [min(times) for times in zip(*runs, strict=True)]


def stages(method: JointMethod, data: Dataset) -> dict[str, list[float]]:
    """Seconds of each stage, frame by frame."""
    observations = Observations.of(data)
    seconds: dict[str, list[float]] = {"proposals": [], "map of touches": [], "whole frame": []}
    propose, whole = proposed(method), method.predict
    for i in range(len(data)):
        frame = observations[i : i + 1]
        whole(frame)
        for name, run in (("proposals", propose), ("whole frame", whole)):
            start = time.process_time()
            run(frame)
            seconds[name].append(time.process_time() - start)
        x, y = whole(frame).touches[0].place.T[:, None]
        start = time.process_time()
        touch_maps(x, y, np.full_like(x, method.radius), method.size, method.shape)
        seconds["map of touches"].append(time.process_time() - start)
    rest = zip(
        *(seconds[name] for name in ("whole frame", "proposals", "map of touches")), strict=True
    )
    seconds["angles and fit"] = [all_of_it - network - drawn for all_of_it, network, drawn in rest]
    return seconds


if __name__ == "__main__":
    main()
