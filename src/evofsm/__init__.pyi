from .fsm import Category as Category
from .fsm import Event as Event
from .fsm import EvolvingFSM as EvolvingFSM
from .fsm import Forecasts as Forecasts
from .fsm import FSMModel as FSMModel
from .fsm import IntervalActions as IntervalActions
from .fsm import Labels as Labels
from .fsm import Novelty as Novelty
from .fsm import ObservationEncoder as ObservationEncoder
from .fsm import Paper as Paper
from .fsm import jensen_shannon as jensen_shannon
from .fsm import register_rule as register_rule
from .guard import Guard as Guard
from .guard import warm as warm
from .store import read_header as read_header

__version__: str
