"""Detection: who sees danger, how early, and at how many false alarms."""
