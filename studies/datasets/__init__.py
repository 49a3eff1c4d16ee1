"""Readers of public car-following data in their own layouts, as leader-follower episodes.

Nothing is downloaded: users fetch the files themselves, under the licences of those who made
them, and may put a list of checksums beside them, which is then held against what is read.
"""
