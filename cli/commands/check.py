"""`eitskin check`: diagnosis of boards and recordings, and a list of serial ports."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from eitskin import datasets, hardware, simulator, training
from eitskin.cli import options
from eitskin.cli.commands.recorded_frames import Values, read_recorded, required_protocol
from eitskin.cli.commands.tare import ReferenceFile, tell_unjudged, use_reference
from eitskin.errors import ConfigurationError, FrameError

if TYPE_CHECKING:
    from eitskin.hardware.diagnosis.checked_frames import Finding
    from eitskin.hardware.diagnosis.reading_check import LawCheck

Recording = Annotated[
    Path | None,
    typer.Option(help="Check a dataset or a file as `import` reads it, instead of a board."),
]

EXIT_UNHEALTHY = 4
FRAMES = 16  # that are measured
NO_EXPECTED = (
    "touch positions predict no impedances: checking without expected values; give a stored "
    "--reference (eitskin tare) to compare with"
)
SHIPPED_PIPELINE = Path("reference.eitmodel")


@options.with_output
def ports(*, output: options.Output) -> None:
    """List the serial ports of this machine, and how to name each of them."""
    from eitskin.hardware.boards.port import serial_ports

    port_list = serial_ports()
    lines = [f"{port.uri}  {port}" for port in port_list]  # whole, to be copied
    listed = [{**dataclasses.asdict(port), "uri": port.uri} for port in port_list]
    output.result({"ports": listed}, "\n".join(lines) or "no serial port was found here")


@options.with_output
def command(
    model: Annotated[
        Path | None,
        typer.Argument(
            help="Trained pipeline with the expected impedances; reference.eitmodel if omitted and "
            "the board has its protocol."
        ),
    ] = None,
    *,
    board: options.BoardOption = None,
    frames: Annotated[int, typer.Option(min=1, help="Number of frames to measure.")] = FRAMES,
    recording: Recording = None,
    values: Values = None,
    protocol: options.MeasuredPairs = None,
    reference: ReferenceFile = None,
    method: options.MethodCode = None,
    calibrate: Annotated[
        bool, typer.Option("--calibrate", help="Have the board measure its resistor RCAL first.")
    ] = False,
    seed: int = 0,
    output: options.Output,
) -> None:
    """Find faults of a flat, untouched sensor on a board, or of any recording.

    Names open, loose, shorted and swapped electrodes, bad contacts, faulty channels and boards, and
    a sensor that is bent. In recordings: dead, stuck and clipped channels, and boards that are not
    ideal meters. Exit code 4 if something is found.
    """
    if recording is not None:
        if model is not None:
            raise ConfigurationError(
                f"a recording is checked without a model, got {model}; leave MODEL or --recording "
                "out"
            )
        data = read_recorded(recording, values, protocol)
        table = required_protocol(data)
        readings = hardware.check_readings(data.impedance, table, data.status)
        found = SensorFindings((*readings.findings, *_failed_electrodes(data)), readings.laws)
        _report({"recording": str(recording)}, found, table, len(data), output)
    else:
        if values or protocol:
            raise ConfigurationError("--values and --protocol describe a --recording; name one")
        pipeline = training.open_pipeline(model or SHIPPED_PIPELINE, options.own_method(method))
        spec, uri = pipeline.layout, options.named_board(board)
        with options.opened_board(uri, seed, spec) as opened:
            suits = model is not None or opened.protocol == spec.known_protocol
            if suits:
                spec.require_same_measurements(opened.protocol, opened.info.frequency)
            else:
                output.note(
                    f"{SHIPPED_PIPELINE} is for {spec.known_protocol}, the board measures "
                    f"{opened.protocol}: checking without a model; name a pipeline for this "
                    "sensor to check its values, too"
                )
            if reference is not None:
                use_reference(pipeline, reference, opened.info, output)
            if calibrate:
                opened.calibrate()
            output.note(f"measuring {frames} frames; keep the sensor flat and untouched")
            taken_frames = list(islice(opened.frames(), frames))
        if suits and pipeline.expected_magnitudes is None:
            output.note(NO_EXPECTED)
        elif suits:
            tell_unjudged(pipeline, output)
        findings = sensor_findings(pipeline if suits else None, taken_frames)
        _report({"board": uri}, findings, taken_frames[0].protocol, len(taken_frames), output)


def _failed_electrodes(data: "datasets.Dataset") -> "tuple[Finding, ...]":
    """Findings of electrodes that failed in a recording, by the range of its first readings."""
    from eitskin.hardware.diagnosis.checked_frames import Finding, FindingKind
    from eitskin.training.method.sensor_health import follow_recording

    return tuple(
        Finding(FindingKind.FAILED, (fault.electrode,), fault.channels, str(fault))
        for fault in follow_recording(data, grows=False)[1]
    )


class SensorFindings(NamedTuple):
    """Findings on a sensor, and the laws that its frames were compared with."""

    findings: "tuple[Finding, ...]"
    laws: "Sequence[LawCheck]"

    @property
    def sentences(self) -> "Iterator[str]":
        """A sentence on each law, or that none applies to the measurements."""
        for law in self.laws:
            yield (
                f"{law.kind}: {law.relations} compared, median difference "
                f"{100.0 * law.median:.2g} %, largest {100.0 * law.largest:.2g} %"
            )
        if not self.laws:
            yield "no redundant measurements in this protocol, so its consistency was not tested"

    def describe(self, frames: int) -> str:
        """A sentence on each finding, or that there is none in so many frames."""
        messages = "\n".join(finding.message for finding in self.findings)
        return messages or f"healthy: no fault in {frames} frames"


def sensor_findings(
    pipeline: "training.Pipeline | None",
    taken_frames: "Sequence[simulator.Frame]",
    estimate: "Callable[[], hardware.Estimate] | None" = None,
) -> SensorFindings:
    """Findings on the flat, untouched sensor in frames that were taken of it.

    Args:
        pipeline: knows the sensor's values; None where it is for another protocol.
        taken_frames: frames.
        estimate: gives the pipeline's estimate of the last one, and may raise FrameError; the
            pipeline processes all of them when omitted.
    """
    from eitskin.hardware.diagnosis.reading_check import LAWS, check_frames

    readings = check_frames(taken_frames)
    findings = readings.findings
    if pipeline is not None and (expected := pipeline.expected_magnitudes) is not None:
        check_findings = hardware.check_sensor(taken_frames, expected).findings
        findings = (*check_findings, *(finding for finding in findings if finding.what in LAWS))
        # Other faults make a sensor look bent or pressed.
        if pipeline.targets.states or pipeline.targets.angle:
            own = estimate or (lambda: [pipeline.process(each) for each in taken_frames][-1])
            findings = findings or _not_flat(pipeline, own)
    return SensorFindings(findings, readings.laws)


def _not_flat(
    pipeline: "training.Pipeline", estimated: "Callable[[], hardware.Estimate]"
) -> "tuple[Finding, ...]":
    """Finding of a sensor that is bent or pressed, by its stored reference or by other sensors."""
    from eitskin.hardware.diagnosis.checked_frames import Finding, FindingKind

    try:
        estimate = estimated()
    except FrameError as error:  # of another sensor, by all channels together
        return (Finding(FindingKind.MISFIT, (), (), str(error)),)
    if pipeline.stored_reference is None:
        doubt = next((text for text in estimate.problems if "look flat" in text), "")
    elif estimate.state is datasets.State.IDLE:
        doubt = ""
    else:
        shown = "unknown" if estimate.bend_angle_deg is None else f"{estimate.bend_angle_deg:+.1f}"
        doubt = (
            f"the sensor is not as its reference was taken, "
            f"{pipeline.stored_reference.zero}: bent by {shown}"
            f" deg from it, {len(estimate.touches or ())} touches; release it for the check, or "
            "take the reference again (eitskin tare)"
        )
    return (Finding(FindingKind.NOT_FLAT, (), (), doubt),) if doubt else ()


def _report(
    source: dict[str, str],
    found: SensorFindings,
    protocol: "simulator.Protocol",
    frames: int,
    output: options.Output,
) -> None:
    """Print the findings, or that there are none; raises Exit where there are."""
    for sentence in found.sentences:
        output.note(sentence)
    result = {
        "healthy": not found.findings,
        "frames": frames,
        "laws": [{**dataclasses.asdict(law), "kind": str(law.kind)} for law in found.laws],
        "findings": [
            {
                "what": str(finding.what),
                "electrodes": list(finding.electrodes),
                "channels": [protocol.labels[k] for k in finding.channels],
                "message": finding.message,
            }
            for finding in found.findings
        ],
    }
    output.result(source | result, found.describe(frames))
    if found.findings:
        raise typer.Exit(EXIT_UNHEALTHY)
