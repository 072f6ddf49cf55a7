"""The public names of `vibench.calibration`: data, decisions by error bounds, and methods made of these."""

from .data import Data as Data
from .data import Prior as Prior
from .data import read_data as read_data
from .decisions import BoundedSensors as BoundedSensors
from .decisions import CompiledSensors as CompiledSensors
from .decisions import Decisions as Decisions
from .decisions import Interval as Interval
from .decisions import Prediction as Prediction
from .decisions import RefutedError as RefutedError
from .metropolis import Metropolis as Metropolis
from .metropolis import summary as summary
from .ranked import minimise as minimise
