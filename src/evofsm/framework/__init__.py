"""The online evolving framework: a controller proposes, a reviser improves, a machine learns.

The paper's Section 4. Nothing here knows who the controller is or where it drives.
"""
