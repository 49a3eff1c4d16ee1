from .river import RiverClusterer as RiverClusterer
from .sklearn import EvolvingClusterer as EvolvingClusterer
