"""Studies: each makes numbers and draws nothing."""
