from .cli import commands as commands
from .frame import Frame as Frame
from .studies import STUDIES as STUDIES
from .study import Study as Study
from .systems.rivals.rival import Rival as Rival
from .systems.system import Box as Box
from .systems.system import Discrete as Discrete
from .systems.system import System as System
