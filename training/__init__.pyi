"""Public names of eitskin.training, and where each is defined."""

from eitskin.training.evaluation.evaluate import (
    PositionScore as PositionScore,
)
from eitskin.training.evaluation.evaluate import (
    RecordedTouches as RecordedTouches,
)
from eitskin.training.evaluation.evaluate import (
    Report as Report,
)
from eitskin.training.evaluation.evaluate import (
    evaluate as evaluate,
)
from eitskin.training.method.input_spec import InputSpec as InputSpec
from eitskin.training.method.interface import Method as Method
from eitskin.training.method.known_frames import FrameLabel as FrameLabel
from eitskin.training.method.known_frames import TouchLabel as TouchLabel
from eitskin.training.method.observations import Observations as Observations
from eitskin.training.method.predictions import (
    Estimate as Estimate,
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
from eitskin.training.method.predictions import (
    TouchEstimate as TouchEstimate,
)
from eitskin.training.method.predictions import (
    Zero as Zero,
)
from eitskin.training.method.settings import (
    NetworkSettings as NetworkSettings,
)
from eitskin.training.method.settings import (
    TrainingSettings as TrainingSettings,
)
from eitskin.training.method.targets import (
    Targets as Targets,
)
from eitskin.training.method.targets import (
    TrainingFrames as TrainingFrames,
)
from eitskin.training.pipeline.pipeline import (
    Pipeline as Pipeline,
)
from eitskin.training.pipeline.pipeline import (
    open_pipeline as open_pipeline,
)
from eitskin.training.pipeline.references import (
    StoredReference as StoredReference,
)
from eitskin.training.reconstruction.pixel_grid import (
    FiguresOfMerit as FiguresOfMerit,
)
from eitskin.training.reconstruction.pixel_grid import PixelGrid as PixelGrid
from eitskin.training.reconstruction.pixel_grid import (
    figures_of_merit as figures_of_merit,
)
from eitskin.training.reconstruction.reconstructor import (
    Reconstructor as Reconstructor,
)
from eitskin.training.reconstruction.regularised_inverse import (
    Regularisation as Regularisation,
)
from eitskin.training.twin.parameters import TwinPrior as TwinPrior
from eitskin.training.twin.twin import PressedTwin as PressedTwin
from eitskin.training.twin.twin import Twin as Twin
