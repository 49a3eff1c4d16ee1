from .executors import in_order as in_order
