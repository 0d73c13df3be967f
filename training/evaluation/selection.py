"""Selection of the method by held-out specimens."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from eitskin.datasets import Dataset, State
from eitskin.geometry import DataError
from eitskin.training.evaluation.evaluate import Evaluation
from eitskin.training.evaluation.scores import GATE, Report, ospa
from eitskin.training.method.settings import Progress, TrainingSettings, silent
from eitskin.training.method.targets import STATE_NAMES, Targets, with_implied_labels
from eitskin.training.pipeline.pipeline import Pipeline

CANDIDATES = ("joint", "quick")
FEW_SPECIMENS = 10  # below, a choice of other held-out specimens may give other figures
FEW_FRAMES = 100  # of a state
BRIEF = 0.15
"""Share of the epochs after which candidates are compared for the first time."""
HOPELESS = 2.0
"""Ratio of a candidate's loss to the least one from which its training is not continued."""
BRIEFLY_JUDGED = 200  # held-out frames
LEAST_R2, LEAST_FOUND = 0.25, 0.3  # below, angles and positions are hardly better than guessed
WRONG_ERRORS = 2.0  # ratio of errors and their standard errors from which it is reported


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """Candidate of a selection.

    Attributes:
        preset: name of its settings.
        seconds: time of its training and evaluation [s].
        refusal: reason why it cannot be trained on the dataset; empty otherwise.
        evaluation: evaluation on the held-out frames; None for one that is refused.
        losses: losses of each target, 0 for no error to 1 for a guess; see `quantity_losses`.
        stopped: reason why its training ended early; empty otherwise.
        share: share of the epochs that it was trained for.
    """

    preset: str
    seconds: float
    refusal: str
    evaluation: Evaluation | None
    losses: dict[str, float]
    stopped: str = ""
    share: float = 1.0

    @property
    def loss(self) -> float:
        """Mean of the losses; infinite for a candidate that is refused."""
        return float(np.mean(list(self.losses.values()))) if self.losses else float("inf")

    @property
    def figures(self) -> dict[str, float | None]:
        """Figures that are compared; None where not tested.

        Mean share of recognised frames over the states, mean distance of matched touches [mm],
        shares of true touches found and of false ones, root mean square error of the angle [deg].
        """
        if self.evaluation is None:
            return {}
        report, matches = self.evaluation.report, self.evaluation.matches
        shares = [share for share in report.states.accuracy.values() if share is not None]
        touches = int(self.evaluation.dataset.touch_count.sum()) if report.touches else 0
        error = matches.error
        return {
            "states": float(np.mean(shares)) if shares else None,
            "error_mm": 1e3 * float(error.mean()) if len(error) else None,
            "found": len(error) / touches if touches else None,
            "false_per_touch": float(matches.false.sum()) / touches if touches else None,
            "angle_rmse_deg": report.bend.rmse_deg,
        }

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "preset": self.preset,
            "seconds": round(self.seconds, 1),
            "refusal": self.refusal,
            "stopped": self.stopped,
            "loss": self.loss if self.losses else None,
            "losses": self.losses,
            "figures": self.figures,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """Candidates and the one of the smallest loss.

    Attributes:
        trials: trials of all candidates.
        evaluation: evaluation of the chosen one, whose pipeline is trained.
        preset: name of the chosen one's settings.
    """

    trials: tuple[Trial, ...]
    evaluation: Evaluation
    preset: str

    @classmethod
    def from_dataset(
        cls,
        dataset: Dataset,
        seed: int = 0,
        presets: Sequence[str] = CANDIDATES,
        epochs: int | None = None,
        progress: Progress = silent,
    ) -> "Selection":
        """Train the candidates on one part of the specimens and test them on the others.

        All candidates see the same frames (`hold_out`). They are compared after a brief training
        first: one that has an error `HOPELESS` times as much as the best goes no further
        (successive halving, Jamieson and Talwalkar 2016). The chosen pipeline is the one that was
        tested; its figures are of frames that it was chosen by, which favours it a little.

        Args:
            dataset: frames, as `Pipeline.fit` takes them.
            seed: seed of the held-out part and of the training.
            presets: names of the candidates.
            epochs: passes over the frames, instead of those of the candidates' settings.
            progress: called with a stage, steps done and steps in all.

        Raises DataError where no candidate can be trained on the dataset.
        """

        def trial(preset: str, share: float) -> Trial:
            settings = replace(TrainingSettings.preset(preset, seed), whole_specimens=True)
            if epochs is not None:
                settings = settings.with_epochs(epochs)
            return train_candidate(dataset, preset, settings, share, progress)

        brief: list[Trial] = []
        for preset in presets:
            rivals = len(presets) - 1 - sum(bool(each.refusal) for each in brief)
            brief.append(trial(preset, BRIEF if rivals else 1.0))
        leader, trials = min(brief, key=lambda each: each.loss), []
        for each in brief:
            if each.refusal or each.share == 1.0:
                trials.append(each)
            elif each.loss > HOPELESS * leader.loss:
                why = f"after {BRIEF:.0%} of the training its loss was {each.loss:.3f}, that of "
                trials.append(replace(each, stopped=f"{why}{leader.preset} {leader.loss:.3f}"))
            else:
                full = trial(each.preset, 1.0)
                trials.append(replace(full, seconds=each.seconds + full.seconds))
        best = min((trial for trial in trials if not trial.stopped), key=lambda each: each.loss)
        if best.evaluation is None:
            reasons = "; ".join(f"{trial.preset}: {trial.refusal}" for trial in trials)
            raise DataError(f"no method can be trained on this dataset: {reasons}")
        best.evaluation.pipeline.metrics["selection"] = [trial.as_dict() for trial in trials]
        return cls(tuple(trials), best.evaluation, best.preset)


def train_candidate(
    dataset: Dataset, preset: str, settings: TrainingSettings, share: float, progress: Progress
) -> Trial:
    """The candidate, trained for a share of its epochs and tested, or refused."""
    start, words = time.perf_counter(), preset if share == 1.0 else f"{preset}, briefly"
    try:
        pipeline = Pipeline.fit(
            dataset,
            settings if share == 1.0 else settings.shorten(share),
            lambda stage, *steps: progress(f"{words}: {stage}", *steps),
        )
    except DataError as error:
        return Trial(preset, time.perf_counter() - start, str(error), None, {})
    frames = pipeline.held_out(dataset)
    if share < 1.0:
        frames = frames[:: max(1, -(-len(frames) // BRIEFLY_JUDGED))]
    evaluation = Evaluation.from_dataset(pipeline, dataset.select(frames))
    losses = quantity_losses(evaluation, Targets.from_dataset(with_implied_labels(dataset)))
    return Trial(preset, time.perf_counter() - start, "", evaluation, losses, share=share)


def quantity_losses(evaluation: Evaluation, labels: Targets) -> dict[str, float]:
    """Loss of each quantity that the frames have labels for, 0 to 1; 1 where it is not estimated.

    - "state": one minus the mean share of recognised frames over the states (balanced error rate).
    - "touches": OSPA distance of found and true touches over its cut-off, mean of the frames with
      either.
    - "angle": root mean square error over the standard deviation of the angles, at most 1.
    """
    data, report = evaluation.dataset, evaluation.report
    estimated, losses = evaluation.pipeline.targets.intersection(labels), {}
    if labels.states:
        accuracy, losses["state"] = report.states.accuracy, 1.0
        if estimated.states:  # a state that is not distinguished is never recognised
            shares = [
                accuracy[name] if name in report.estimates.states else 0.0 for name in labels.states
            ]
            losses["state"] -= float(np.mean([s for s in shares if s is not None] or [0.0]))
    if labels.touches:
        distances = [1.0]
        if estimated.touches:
            truth = np.stack([data.touch_x, data.touch_y], axis=2).astype(float)
            pairs = (
                (places[np.isfinite(places[:, 0])], touches.place)
                for places, touches in zip(truth, evaluation.predictions.touches, strict=True)
            )
            distances = [ospa(*pair) / GATE for pair in pairs if any(map(len, pair))]
        losses["touches"] = float(np.mean(distances)) if distances else 0.0
    if labels.angle:
        angles, rmse = data.bend_angle_deg[data.state == State.BEND], report.bend.rmse_deg
        spread = float(np.nanstd(angles)) if len(angles) else 0.0
        losses["angle"] = 1.0
        if estimated.angle and rmse is not None and spread > 0.0:
            losses["angle"] = min(1.0, rmse / spread)
    return losses


def _left_out(data: Dataset, evaluation: Evaluation) -> list[str]:
    """Warning where own sensors, or most of the frames, are in no training part."""
    kept = data.select(evaluation.pipeline.settings.split(data)[0])
    unseen = set(data.specimen_names) - set(kept.specimen_names)
    own = sorted(unseen & set(data.names.specimens.values()))
    if not own and 2 * len(kept) >= len(data):
        return []
    note = f"; {', '.join(own[:8])} not among them" if own else ""
    return [
        f"{len(kept)} of {len(data)} frames were trained on, as specimens are held out whole{note}"
        ": another --seed deals them otherwise"
    ]


def _describe_guesses(report: Report) -> list[str]:
    """Quantities of an evaluation that are hardly better than guessed, in words."""
    found = [share for share in report.states.accuracy.values() if share is not None]
    single, r2 = report.touches.get("1"), report.bend.r2
    guessed = []
    if len(found) > 1 and np.mean(found) < 0.5 * (1.0 + 1.0 / len(found)):
        guessed.append(f"states ({np.mean(found):.0%} recognised)")
    if r2 is not None and r2 < LEAST_R2:
        guessed.append(f"the bend angle (R2 {r2:.2f})")
    if single is not None and single.found < LEAST_FOUND:
        guessed.append(f"positions ({single.found:.0%} of single touches within 15 mm)")
    return guessed


def data_warnings(dataset: Dataset, evaluation: Evaluation) -> tuple[str, ...]:
    """Reasons why the figures of an evaluation may not hold for another sensor, in words.

    Args:
        dataset: all frames, of training and evaluation.
        evaluation: evaluation of the held-out frames.
    """
    data, report = with_implied_labels(dataset), evaluation.report
    warnings = []
    specimens, judged = (len(np.unique(each.specimen)) for each in (data, evaluation.dataset))
    if specimens == 1:
        warnings.append(
            "all frames are of one sensor: the figures hold for this one, another may be worse by "
            "far more; record or generate further specimens"
        )
    elif specimens < FEW_SPECIMENS:
        warnings.append(
            f"{specimens} specimens are few, {judged} of them held out: other ones would give "
            f"other figures; {FEW_SPECIMENS} and more make them reliable"
        )
    warnings += _left_out(data, evaluation)
    for state, name in zip(State, STATE_NAMES, strict=True):
        count = int(np.sum(data.state == state))
        if 0 < count < FEW_FRAMES:
            warnings.append(f"{count} frames of the state {name} are few; {FEW_FRAMES} are better")
    stated = {"positions": report.place_calibration, "the bend angle": report.bend.calibration}
    for name, problem in stated.items():
        if problem is not None and problem.rms_ratio > WRONG_ERRORS:
            warnings.append(
                f"errors of {name} are {problem.rms_ratio:.1f} times their standard errors: do not "
                "rely on these; train on more specimens"
            )
    if guesses := _describe_guesses(report):
        warnings.append(
            f"{' and '.join(guesses)}: hardly better than guessing on held-out specimens; check "
            "labels and their order, or train on more frames"
        )
    return tuple(warnings)
