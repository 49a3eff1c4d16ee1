"""How well it is foreseen whether a task fails within so many steps, and by whom.

`data` says what is run, `ours` and `rivals` who foresees, `measures` how that is judged, and
`study` does it for all of them.
"""
