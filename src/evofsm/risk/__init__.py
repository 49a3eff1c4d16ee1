"""How dangerous a situation is: dead ends, and the measures in use today."""
