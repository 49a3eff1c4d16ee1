from .cli import commands as commands
from .frame import Frame as Frame
from .studies import STUDIES as STUDIES
from .study import Study as Study
