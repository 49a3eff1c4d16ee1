"""How well the state some seconds ahead is forecast, and against what.

`sources` says what is driven or read, `forecasters` who forecasts, `scoring` how that is judged,
and `study` does it for all of them.
"""
