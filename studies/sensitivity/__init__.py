"""How far the paper's claims depend on the settings that it leaves open.

`parameters` says what is varied and within which limits, `setting` drives the paper's study with
one choice of them, `designs` chooses, `study` does it many times, and `shares` reads the result.
"""
