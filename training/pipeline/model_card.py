"""Model card of a saved pipeline: purpose, training data, limits and metrics, in Markdown."""

import json
from collections.abc import Mapping
from typing import Any

from eitskin.config import from_dict
from eitskin.geometry.design.sensor import SensorDesign

PERCEPTION = """\
# A perception pipeline for electrical-impedance robot skin

Load it with `eitskin.training.Pipeline.load`; it needs eitskin and {code}, and holds no
pickled objects.

**Made for** a {length:g} x {width:g} mm sensor with {electrodes} electrodes, {measurements}
measurements a frame at {frequency:g} kHz, values in ohm. Frames of another table
or frequency are refused, and so are sensors whose values are far from those of training.

**Estimates** {estimates}.

**Trained on** {frames} {source} frames, seed {seed}, by the {method} method. Conditions absent from
these frames (other indenters, wear) are untested.

**Limits.** A session must begin with the sensor flat and untouched.{limits}

## Metrics

```json
{metrics}
```
"""

ANGLE_LIMITS = """ The gain of an uncalibrated
angle errs by 10 % and more between sensors of one design: calibrate for angles. For a touched
sensor the paper's method gives the angle before the touch."""
CORNER = "the corner of the conductive layer"
FLAT_LIMITS = """ It was trained without bends:
a sensor that is bent later may be taken for a touched one."""

POSITION = """\
# Touch positions for a recorded electrical-impedance skin

Load it with `eitskin.training.RecordedTouches.load`; it needs eitskin and no other code, and holds
no pickled objects.

**Made for** the one sensor it was recorded from, {channels} channels in the recording's order and
units. From a frame and a frame of the untouched sensor it estimates the position of one touch, in
metres, with a standard error.

**Trained on** {frames} {source} frames with one touch each.

**Limits.** A session must begin with the sensor untouched. Whether it is touched later is not
estimated: a change of at least a fifth of the usual touch is given a position. Neither bends nor
forces are estimated.

## Metrics

```json
{metrics}
```
"""


def perception_card(document: Mapping[str, Any]) -> str:
    """Markdown for a perception pipeline described by `document`."""
    layout = document["layout"]
    outline = from_dict(SensorDesign, layout["design"], "layout.design").outline
    return PERCEPTION.format(
        length=outline.length * 1e3,
        width=outline.width * 1e3,
        electrodes=layout["protocol"]["n_electrodes"],
        measurements=len(layout["protocol"]["table"]),
        frequency=layout["frequency"] / 1e3,
        seed=document["settings"]["seed"],
        estimates=_estimates(document["estimates"]),
        limits=ANGLE_LIMITS if document["estimates"]["angle"] else FLAT_LIMITS,
        method=document["method"],
        code=f"the code of {document['method']}" if ":" in document["method"] else "no other code",
        **_training(document),
    )


def position_card(document: Mapping[str, Any]) -> str:
    """Markdown for learned touch positions described by `document`."""
    return POSITION.format(channels=document["channels"], **_training(document))


def _estimates(targets: Mapping[str, Any]) -> str:
    """The quantities that are estimated, as a list in words."""
    parts = {
        f"the state ({' or '.join(targets['states'])})": bool(targets["states"]),
        "the bend angle in degrees": targets["angle"],
        f"the positions of touches in metres from {CORNER}": targets["touches"],
        "their forces in newtons": targets["force"],
    }
    return ", ".join(words for words, estimated in parts.items() if estimated)


def _training(document: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "frames": document["trained_on"]["frames"],
        "source": document["trained_on"]["source"],
        "metrics": json.dumps(document["metrics"], indent=1) if document["metrics"] else "{}",
    }
