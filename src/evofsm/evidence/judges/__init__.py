"""Does the learnt judge keep any system from failing, and which of its parts is that owed to?"""
