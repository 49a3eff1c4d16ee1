from .core import Category as Category
from .core import Edges as Edges
from .core import Event as Event
from .core import EvolvingFSM as EvolvingFSM
from .core import Explanation as Explanation
from .core import FailureSplit as FailureSplit
from .core import Forecasts as Forecasts
from .core import FSMModel as FSMModel
from .core import IntervalActions as IntervalActions
from .core import Labels as Labels
from .core import Missing as Missing
from .core import Novelty as Novelty
from .core import ObservationEncoder as ObservationEncoder
from .core import Paper as Paper
from .core import StateRule as StateRule
from .core import Step as Step
from .core import Tally as Tally
from .core import Trace as Trace
from .core import WhenFull as WhenFull
from .core import jensen_shannon as jensen_shannon
from .core import model_html as model_html
from .core import wilson_bounds as wilson_bounds
from .files import read_header as read_header
from .fleet import Fleet as Fleet
from .fleet import merge as merge
from .guard import Guard as Guard

__version__: str
