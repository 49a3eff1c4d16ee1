from .cli import commands as commands
from .studies import STUDIES as STUDIES
from .study import Frame as Frame
from .study import Study as Study
