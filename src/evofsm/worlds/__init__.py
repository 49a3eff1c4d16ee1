"""Where it drives: the same scenario with the same controllers, in closed form or in SUMO."""
