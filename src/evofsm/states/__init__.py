"""How states are determined and recognised: one rule, one file."""
