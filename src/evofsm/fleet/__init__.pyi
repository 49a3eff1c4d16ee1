from .campaign import Batch as Batch
from .campaign import run_campaign as run_campaign
from .executors import Processes as Processes
from .executors import cluster as cluster
from .executors import cluster_threads as cluster_threads
from .executors import in_order as in_order
