"""Public names of eitskin, and where each is defined."""

from eitskin.datasets.generation.generate import generate as generate
from eitskin.datasets.recipe.recipe import Recipe as Recipe
from eitskin.datasets.store.folder import open_dataset as open_dataset
from eitskin.errors import EitskinError as EitskinError
from eitskin.frame import Frame as Frame
from eitskin.geometry.deformation.fixtures import Bend as Bend
from eitskin.geometry.design.sensor import SensorDesign as SensorDesign
from eitskin.hardware.opening import open_board as open_board
from eitskin.protocol import Protocol as Protocol
from eitskin.simulator.electrical.forward_model import ForwardModel as ForwardModel
from eitskin.simulator.scene.scene import Scene as Scene
from eitskin.simulator.scene.scene import Touch as Touch
from eitskin.simulator.simulator import Simulator as Simulator
from eitskin.training.pipeline.pipeline import Pipeline as Pipeline
from eitskin.training.reconstruction.reconstructor import Reconstructor as Reconstructor

__version__: str
