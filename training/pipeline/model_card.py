"""The model card of a saved pipeline: what it is, for people."""

import json
from collections.abc import Mapping
from typing import Any

from eitskin.config import from_dict
from eitskin.geometry.design.sensor import SensorDesign

PERCEPTION = """\
# A perception pipeline for electrical-impedance robot skin

Load it with `eitskin.training.Pipeline.load`; it needs eitskin and no other code, and holds no
pickled objects.

**Made for** a {length:g} x {width:g} mm sensor with {electrodes} electrodes, {measurements}
measurements a frame at {frequency:g} kHz, values in ohm. It refuses frames of another table or
frequency, and sensors whose values are far from those it was trained with.

**Says** whether the skin is idle, touched or bent, the bend angle in degrees, and where it is
touched, in metres from the corner of the conductive layer.

**Trained on** {frames} {source} frames, seed {seed}, by the {method} method. What they do not hold
(other indenters, wear) it has not seen.

**Limits.** A session must begin with the sensor flat and untouched. Sensors of one design bend with
gains that differ by a tenth and more: calibrate for angles. The paper's method gives a touched
sensor the angle that it had before the touch.

## How good it was found to be

```json
{metrics}
```
"""

POSITION = """\
# Touch positions for a recorded electrical-impedance skin

Load it with `eitskin.training.RecordedTouches.load`; it needs eitskin and no other code, and holds
no pickled objects.

**Made for** the one sensor it was recorded from, {channels} channels in the recording's order and
units. From a frame and a frame of the untouched sensor it says where one touch is, in metres.

**Trained on** {frames} {source} frames with one touch each.

**Limits.** It says a place for every frame, touched or not, and only one.

## How good it was found to be

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
        method=document["method"],
        **_training(document),
    )


def position_card(document: Mapping[str, Any]) -> str:
    """Markdown for learned touch positions described by `document`."""
    return POSITION.format(channels=document["channels"], **_training(document))


def _training(document: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "frames": document["trained_on"]["frames"],
        "source": document["trained_on"]["source"],
        "metrics": json.dumps(document["metrics"], indent=1) if document["metrics"] else "{}",
    }
