"""What a machine learns of how its system moves, beside its states: see `dynamics.Dynamics`."""
