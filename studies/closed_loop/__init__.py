"""The closed loop: whether the reviser prevents collisions, at what cost, and against whom."""
