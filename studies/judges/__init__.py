"""Whether the learnt judge keeps systems from failing, and to which of its parts that is owed."""
