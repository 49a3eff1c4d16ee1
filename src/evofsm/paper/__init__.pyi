from .command import Paper as Paper
from .frame import Frame as Frame
from .study import Study as Study
