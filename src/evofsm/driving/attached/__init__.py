"""Guards in a SUMO simulation of someone else's: chosen cars are guarded, or only watched."""
