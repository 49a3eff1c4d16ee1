from .kinds import Kind as Kind
from .kinds import kind_of as kind_of
from .running import Outcome as Outcome
from .running import Result as Result
from .running import cases as cases
from .running import check as check
