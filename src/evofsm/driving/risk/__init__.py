"""How dangerous a situation is: dead ends if the leader brakes, and measures in use today."""
