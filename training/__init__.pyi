"""Public names of eitskin.training, and where each is defined."""

from eitskin.training.evaluation.evaluate import (
    Report as Report,
)
from eitskin.training.evaluation.evaluate import (
    evaluate as evaluate,
)
from eitskin.training.method.predictions import (
    FoundTouches as FoundTouches,
)
from eitskin.training.method.predictions import (
    Perceived as Perceived,
)
from eitskin.training.method.predictions import (
    Predictions as Predictions,
)
from eitskin.training.method.settings import (
    NetworkSettings as NetworkSettings,
)
from eitskin.training.method.settings import (
    TrainingSettings as TrainingSettings,
)
from eitskin.training.pipeline.pipeline import (
    Estimate as Estimate,
)
from eitskin.training.pipeline.pipeline import (
    Pipeline as Pipeline,
)
from eitskin.training.positions.recorded_touches import (
    PositionScore as PositionScore,
)
from eitskin.training.positions.recorded_touches import (
    RecordedTouches as RecordedTouches,
)
